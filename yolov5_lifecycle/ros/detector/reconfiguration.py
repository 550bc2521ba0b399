"""Parameter changes: validated as a whole, prepared while detection runs, then committed or rejected."""

from __future__ import annotations

import types
from collections.abc import Generator
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from yolov5_lifecycle.detection.prepared_model import PreparedModel
from yolov5_lifecycle.ros.detector.managed_resources import ManagedResources
from yolov5_lifecycle.ros.detector.session import REFUSALS, Preparation, Session
from yolov5_lifecycle.ros.parameters.settings_parameters import Proposal, SettingsParameters, refused
from yolov5_lifecycle.ros.services import Handler
from yolov5_lifecycle.settings.settings import Settings

_AT_A_TIME = 10
"""Parameters of one request processed before other callbacks are served."""
_TOGETHER = (
    " If it depends on another parameter of this request: set both together through "
    "set_parameters_atomically, or in another order."
)
_OLD_CLASSES = (
    "{names} still names classes of the running model: set it together with the new weights through "
    "set_parameters_atomically, or set it to [] before. The running model stays."
)
_LEFT = "the node left the active state while the new model was loading; nothing was changed."
_BUSY = "another model is being loaded: set this again once that has been answered; nothing was changed."


@dataclass(eq=False)
class Reconfiguration:
    """Handlers of the services that set parameters."""

    node: Node
    parameters: SettingsParameters
    resources: ManagedResources

    def __post_init__(self) -> None:
        self._is_reloading = False

    def handlers(self) -> dict[str, Handler]:
        """Service callbacks by the last component of the service name."""
        return {
            "set_parameters": self._set_one_by_one,
            "set_parameters_atomically": self._set_together,
        }

    async def _set_one_by_one(self, request: Any, response: Any) -> Any:
        asked = [*map(Parameter.from_parameter_msg, request.parameters)]
        whole: Proposal | None = None
        for index, parameter in enumerate(asked):
            if index % _AT_A_TIME == _AT_A_TIME - 1:
                self.node.executor.wake()
                await _pause()
            proposal = self.parameters.propose([parameter])
            result = await self._set(proposal)
            if not result.successful and len(asked) > 1:
                whole = whole or self.parameters.propose(asked)
                if not whole.problems and not proposal.needs_model:
                    result.reason += _TOGETHER
            response.results.append(result)
        return response

    async def _set_together(self, request: Any, response: Any) -> Any:
        asked = [*map(Parameter.from_parameter_msg, request.parameters)]
        response.result = await self._set(self.parameters.propose(asked))
        return response

    async def _set(self, proposal: Proposal) -> SetParametersResult:
        """Apply the whole proposal or nothing."""
        session, is_outdated = self.resources.session, False
        if session is not None and proposal.names_weights and not (proposal.problems or proposal.needs_model):
            is_outdated = await self.resources.is_outdated(session.model)
            # Another request may have come first.
            proposal, session = self.parameters.renewed(proposal), self.resources.session
        if proposal.problems:
            return refused(*proposal.problems)
        if session is not None and (is_outdated or proposal.needs_model):
            return await self._reload(session, proposal)
        return self._commit(proposal, session.preparation if session is not None else None)

    async def _reload(self, session: Session, proposal: Proposal) -> SetParametersResult:
        """Reload, unless another reload runs: it would load a model that this one replaces."""
        if self._is_reloading:
            return refused(_BUSY)
        self._is_reloading = True
        try:
            return await self._reload_now(session, proposal)
        finally:
            self._is_reloading = False

    async def _reload_now(self, session: Session, asked: Proposal) -> SetParametersResult:
        """Load the model, commit `asked` with it, then free whichever model is unused.

        It takes effect between two frames of all cameras: afterwards no frame has the previous model.
        """
        preparation = await self.resources.prepared(lambda: self._wanted(session, asked))
        if preparation is None:
            return self._overtaken(asked)
        try:
            new = preparation.result()
        except REFUSALS as error:
            self.node.get_logger().warning(f"the running model stays, its replacement was refused: {error}")
            return refused(f"{error} The running model stays.")
        unused = new
        try:
            async with self.resources.between_frames():
                if self._wanted(session, asked) is None:
                    return self._overtaken(asked)
                old = session.model
                result = self._commit(self.parameters.renewed(asked), preparation)
                if session.model is new:
                    unused = old
                    self._tell_replaced(old, new, is_file_asked_for=asked.names_weights)
                return result
        finally:
            await self.resources.retire(unused, session)

    def _tell_replaced(self, old: PreparedModel, new: PreparedModel, *, is_file_asked_for: bool) -> None:
        log = self.node.get_logger()
        log.info(f"the model was replaced: {new.summary}")
        is_other_file = (old.weights_path, old.weights_sha256) != (new.weights_path, new.weights_sha256)
        if is_other_file and not is_file_asked_for:
            log.warning(
                f"the weights are no longer those that were loaded before, with sha256 {old.weights_sha256}: "
                f"{new.weights_path} was changed or took their place, and this reload has read it"
            )

    def _wanted(self, session: Session, asked: Proposal) -> Settings | None:
        """The settings with what was `asked`; None if that is obsolete."""
        proposal = self.parameters.renewed(asked)
        is_wanted = self.resources.session is session and not proposal.problems
        return proposal.after.settings if is_wanted else None

    def _overtaken(self, asked: Proposal) -> SetParametersResult:
        """Another change came first and contradicts this one, or another transition came first."""
        proposal = self.parameters.renewed(asked)
        return refused(*proposal.problems) if proposal.problems else refused(_LEFT)

    def _commit(self, proposal: Proposal, preparation: Preparation | None) -> SetParametersResult:
        """Make a valid proposal take effect, with the model of `preparation`, and store it; or nothing."""
        session, before, after = self.resources.session, proposal.base.settings, proposal.after.settings
        if session is None or preparation is None or before is None or after is None or before is after:
            return self.parameters.store(proposal)
        running = session.preparation
        if problems := session.problems(after, preparation.result()):
            result = refused(*problems)
            if preparation is not running:
                names = ", ".join(f"`{problem.setting}`" for problem in problems)
                result.reason = f"{_OLD_CLASSES.format(names=names)} {result.reason}"
            return result
        is_done = False
        try:
            session.apply(after, preparation)
            result = self.parameters.store(proposal)
            is_done = result.successful
        finally:
            if not is_done:
                session.apply(before, running)
        return result


@types.coroutine
def _pause() -> Generator[None, None, None]:
    """Let the executor serve ready callbacks first."""
    yield
