"""Parameter changes: validated as a whole, prepared beside the running model, committed or rejected."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Generator, Sequence
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from yolov5_lifecycle.detection.prepared_model import PreparedModel
from yolov5_lifecycle.detection.selection import MODEL_DEPENDENT, model_problems
from yolov5_lifecycle.ros.detector.model_loader import REFUSALS, ModelLoader
from yolov5_lifecycle.ros.detector.reload_turns import ReloadTurns
from yolov5_lifecycle.ros.detector.session import Detection
from yolov5_lifecycle.ros.parameter_values import read_parameters
from yolov5_lifecycle.ros.parameters import MAX_SUGGESTIONS, SettingsParameters, Validate, refusal
from yolov5_lifecycle.ros.proposal import Proposal
from yolov5_lifecycle.ros.services import Handler
from yolov5_lifecycle.settings.field import Change
from yolov5_lifecycle.settings.settings import SETTINGS_BY_NAME, Problem, Settings, validated

_AT_A_TIME = 10
"""Parameters of one request processed before other callbacks are served."""
_TOGETHER = (
    " All parameters of this request would be valid together: send them through set_parameters_atomically, "
    "or set them in another order."
)
_OLD_CLASSES = (
    " `classes` still names those of the running model: set it together with the new weights through "
    "set_parameters_atomically, or set it to [] before. The running model stays."
)
_NEW_CLASSES = (
    " If these are classes of the new model in this request: set both together through "
    "set_parameters_atomically, or while the node is inactive."
)


class Reconfiguration:
    """Handlers of the services that set parameters.

    `running()` returns the active `Detection`, None unless active; `on_commit(settings)` is called with every
    valid change. `validate` creates settings from values.
    """

    def __init__(
        self,
        node: Node,
        *,
        loader: ModelLoader,
        running: Callable[[], Detection | None],
        on_commit: Callable[[Settings], None],
        arguments: Sequence[str],
        validate: Validate = validated,
    ) -> None:
        self._node = node
        self._loader = loader
        self._running = running
        self._on_commit = on_commit
        self._turns = ReloadTurns(node)
        self.parameters = SettingsParameters(
            node, review=self._review, commit=self._take_effect, arguments=arguments, validate=validate
        )

    def handlers(self) -> dict[str, Handler]:
        """Service callbacks by the last component of the service name."""
        return {"set_parameters": self._set_one_by_one, "set_parameters_atomically": self._set_together}

    async def _set_one_by_one(self, request: Any, response: Any) -> Any:
        asked = read_parameters(request.parameters)
        suggestions = MAX_SUGGESTIONS
        whole: Proposal | None = None
        for index, parameter in enumerate(asked):
            if index % _AT_A_TIME == _AT_A_TIME - 1:
                await self._others()
            proposal = self.parameters.propose([parameter], suggestions=suggestions)
            suggestions -= len(proposal.unknown)
            result = await self._set(proposal)
            if not result.successful and len(asked) > 1:
                whole = whole or self.parameters.propose(asked, suggestions=0)
                result.reason += _remark(proposal, whole)
            response.results.append(result)
        return response

    async def _set_together(self, request: Any, response: Any) -> Any:
        response.result = await self._set(self.parameters.propose(read_parameters(request.parameters)))
        return response

    def _others(self) -> Awaitable[None]:
        if (executor := self._node.executor) is not None:
            executor.wake()
        return _Pause()

    async def _set(self, proposal: Proposal) -> SetParametersResult:
        """Apply the whole proposal or nothing."""
        if proposal.problems:
            return refusal(proposal.problems)
        detection = self._running()
        if detection is not None and proposal.kind is Change.RELOAD:
            return await self._reload(detection, proposal)
        if detection is not None and (problems := self._broken_by(proposal, detection.model)):
            return refusal(problems)
        return self._commit(proposal, None if detection is None else detection.model)

    async def _reload(self, detection: Detection, proposal: Proposal) -> SetParametersResult:
        if not await self._turns.begin():
            return _refused(
                "superseded by a later request that needs another model, too; nothing was changed."
            )
        try:
            return await self._reload_now(detection, proposal)
        finally:
            self._turns.end()

    async def _reload_now(self, detection: Detection, proposal: Proposal) -> SetParametersResult:
        def wanted() -> Settings | None:
            nonlocal proposal
            proposal = self.parameters.renewed(proposal)
            is_wanted = self._running() is detection and not proposal.problems
            return proposal.after.settings if is_wanted else None

        preparation = await self._loader.load(wanted)
        if preparation is None:
            if proposal.problems:
                return refusal(
                    proposal.problems
                )  # another change came first, and the two contradict each other
            return _refused(
                "the node left the active state while the new model was loading; nothing was changed."
            )
        try:
            replacement = preparation.result()
        except REFUSALS as error:
            self._node.get_logger().warning(f"the running model stays, its replacement was refused: {error}")
            return _refused(f"{error} The running model stays.")
        return await self._replace(detection, replacement, proposal)

    async def _replace(
        self, detection: Detection, replacement: PreparedModel, proposal: Proposal
    ) -> SetParametersResult:
        """Commit `proposal` with the model prepared for it, then free whichever model is unused."""
        old = detection.model
        try:
            if problems := self._broken_by(proposal, replacement):
                result = refusal(problems)
                result.reason += _OLD_CLASSES
                return result
            return self._commit(proposal, replacement)
        finally:
            is_replaced = detection.model is replacement
            if is_replaced:
                self._node.get_logger().info(f"the model was replaced: {replacement.summary}")
            await self._loader.retire(old if is_replaced else replacement, after=detection.rest)

    def _commit(self, proposal: Proposal, model: PreparedModel | None) -> SetParametersResult:
        """Store a valid proposal and make it take effect; roll back on an exception."""
        before, running = self.parameters.present(proposal.parameters), self._running()
        old_model = None if running is None else running.model
        result = self.parameters.store(proposal)
        if not result.successful or proposal.after is proposal.base or self.parameters.problems():
            return result
        try:
            self._take_effect(self.parameters.settings(), model)
        except Exception:
            self.parameters.store(self.parameters.propose(before))
            self._take_effect(self.parameters.settings(), old_model)
            raise
        return result

    def _take_effect(self, settings: Settings, model: PreparedModel | None = None) -> None:
        """Apply `settings` to the node and the running detection, with `model` if given."""
        self._on_commit(settings)
        if (detection := self._running()) is not None:
            detection.apply(settings, model or detection.model)

    def _broken_by(self, proposal: Proposal, model: PreparedModel) -> list[Problem]:
        """Constraints of `model` that a valid proposal would violate."""
        settings = proposal.after.settings
        if settings is None or proposal.after is proposal.base:
            return []
        return model_problems(settings, model.detector.class_names)

    def _review(self, candidate: Settings) -> list[Problem]:
        """Problems of `candidate` with the running model."""
        if (detection := self._running()) is None:
            return []
        model = detection.model
        if not model.serves(candidate):
            names = model.settings.differing(candidate, Change.RELOAD)
            return [
                Problem(name, "needs another model, which only the parameter services load.")
                for name in names
            ]
        return model_problems(candidate, model.detector.class_names)


class _Pause:
    """Awaitable that lets the executor serve ready callbacks first."""

    def __await__(self) -> Generator[None, None, None]:
        yield


def _remark(proposal: Proposal, whole: Proposal) -> str:
    """Hint appended to the refusal of one parameter of a request."""
    if proposal.problems:
        return "" if whole.problems else _TOGETHER
    if proposal.kind is Change.RELOAD or not any(map(_depends_on_model, proposal.asked)):
        return ""
    return _NEW_CLASSES if any(map(_needs_reload, whole.asked)) else ""


def _depends_on_model(parameter: Parameter) -> bool:
    return parameter.name in MODEL_DEPENDENT


def _needs_reload(parameter: Parameter) -> bool:
    setting = SETTINGS_BY_NAME.get(parameter.name)
    return setting is not None and setting.change is Change.RELOAD


def _refused(reason: str) -> SetParametersResult:
    return SetParametersResult(successful=False, reason=reason)
