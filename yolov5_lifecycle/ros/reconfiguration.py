"""One change of parameters: judged whole, prepared beside the running model, then committed or refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from yolov5_lifecycle.preparation import PreparedModel
from yolov5_lifecycle.ros.detection import Detection
from yolov5_lifecycle.ros.loading import REFUSALS, ModelLoader
from yolov5_lifecycle.ros.parameters import SettingsParameters, refusal
from yolov5_lifecycle.ros.services import Handler
from yolov5_lifecycle.selection import model_problems
from yolov5_lifecycle.setting import Change
from yolov5_lifecycle.settings import Problem, Settings

_TOGETHER = (
    " All parameters of this request would be valid together: send them through set_parameters_atomically, "
    "or set them in another order."
)


class Reconfiguration:
    """Answers the services that set parameters.

    `running()` is what detects now, None unless active; `on_commit(settings)` is told of every valid change.
    """

    def __init__(
        self,
        node: Node,
        *,
        loader: ModelLoader,
        running: Callable[[], Detection | None],
        on_commit: Callable[[Settings], None],
        arguments: Sequence[str],
    ) -> None:
        self._node = node
        self._loader = loader
        self._running = running
        self._on_commit = on_commit
        self._replacement: PreparedModel | None = None
        self.parameters = SettingsParameters(
            node, review=self._review, commit=self._commit, arguments=arguments
        )

    def handlers(self) -> dict[str, Handler]:
        """Service callbacks by the last part of the service's name."""
        return {"set_parameters": self._set_one_by_one, "set_parameters_atomically": self._set_together}

    async def _set_one_by_one(self, request: Any, response: Any) -> Any:
        parameters = [Parameter.from_parameter_msg(message) for message in request.parameters]
        for parameter in parameters:
            result = await self._set([parameter])
            if self.parameters.problems_of([parameter]) and not self.parameters.problems_of(parameters):
                result.reason += _TOGETHER
            response.results.append(result)
        return response

    async def _set_together(self, request: Any, response: Any) -> Any:
        response.result = await self._set(
            [Parameter.from_parameter_msg(message) for message in request.parameters]
        )
        return response

    async def _set(self, asked: list[Parameter]) -> SetParametersResult:
        """Set all or none; what only takes back an override with an unknown name goes along."""
        taken_back = [parameter for parameter in asked if self.parameters.is_taken_back(parameter)]
        rest = [parameter for parameter in self.parameters.changes(asked) if parameter not in taken_back]
        result = await self._set_known(rest) if rest else SetParametersResult(successful=True)
        if result.successful:
            self.parameters.forget(taken_back)
        return result

    async def _set_known(self, parameters: list[Parameter]) -> SetParametersResult:
        if problems := self.parameters.problems_of(parameters):
            return refusal(problems)
        detection = self._running()
        if detection is None or detection.model.serves(self.parameters.candidate(parameters)):
            return self._node.set_parameters_atomically(parameters)
        return await self._reload(detection, parameters)

    async def _reload(self, detection: Detection, parameters: list[Parameter]) -> SetParametersResult:
        def wanted() -> Settings | None:
            if self._running() is not detection or self.parameters.problems_of(parameters):
                return None
            return self.parameters.candidate(parameters)

        preparation = await self._loader.load(wanted)
        if preparation is None:
            if problems := self.parameters.problems_of(parameters):
                return refusal(problems)  # another change came first, and the two contradict each other
            return _refused(
                "the node left the active state while the new model was loading; nothing was changed."
            )
        try:
            replacement = preparation.result()
        except REFUSALS as error:
            self._node.get_logger().warning(f"the running model stays, its replacement was refused: {error}")
            return _refused(f"{error} The running model stays.")
        return await self._replace(detection, replacement, parameters)

    async def _replace(
        self, detection: Detection, replacement: PreparedModel, parameters: list[Parameter]
    ) -> SetParametersResult:
        """Set `parameters`, which ask for `replacement`; the model that is not used then is freed."""
        old, self._replacement = detection.model, replacement
        try:
            return self._node.set_parameters_atomically(parameters)
        finally:
            self._replacement = None
            is_replaced = detection.model is replacement
            if is_replaced:
                self._node.get_logger().info(f"the model was replaced: {replacement.summary}")
            await self._loader.retire(old if is_replaced else replacement, after=detection.rest)

    def _review(self, candidate: Settings) -> list[Problem]:
        """What the running model, or the one about to replace it, says against `candidate`."""
        detection = self._running()
        if detection is None:
            return []
        model = self._replacement or detection.model
        if not model.serves(candidate):
            names = model.settings.differing(candidate, Change.RELOAD)
            return [
                Problem(name, "needs another model, which only the parameter services load.")
                for name in names
            ]
        return model_problems(candidate, model.detector.class_names)

    def _commit(self, settings: Settings) -> None:
        self._on_commit(settings)
        if (detection := self._running()) is not None:
            detection.apply(settings, self._replacement or detection.model)


def _refused(reason: str) -> SetParametersResult:
    return SetParametersResult(successful=False, reason=reason)
