"""The commands of a page by name, and how they are answered."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from ladarreg_core.errors import LadarregError, OptionError

from ...decoding import quoted
from ...gateway.protocol import READ_ONLY
from ...messages import internal_error, sentence
from . import acquisition, edits, files, jobs, matches, measuring, people, smoothing, stations, ties
from .command import Command, Context, Reply, WorkbenchCommand, commands_in
from .former import present_form
from .projects import PROJECT_COMMANDS

if TYPE_CHECKING:
    from ..state.clients import Client

log = logging.getLogger(__name__)

COMMANDS: dict[str, type[WorkbenchCommand]] = {
    name: command
    for module in (
        matches, measuring, smoothing, edits, files, people, jobs, stations, ties, acquisition,
    )
    for name, command in commands_in(vars(module), WorkbenchCommand).items()
}  # fmt: skip
"""The commands on the open project, by name."""
EVERY_COMMAND: Mapping[str, type[Command]] = {**COMMANDS, **PROJECT_COMMANDS}
"""These and those on projects as a whole."""
URGENT = frozenset(name for name, command in EVERY_COMMAND.items() if command.urgent)
"""The commands that wait neither for earlier ones of their page nor for a thread."""


def answer(context: Context, client: Client, message: Mapping[str, Any]) -> Reply:
    """Execute a page's command and return the reply; an error becomes a sentence."""
    return answer_command(COMMANDS, message, client, lambda command: command.execute(context, client))


def answer_command(
    known: Mapping[str, type[Command]], message: Mapping[str, Any], client: Client, execute: Callable[[Any], Reply]
) -> Reply:
    """Decode a page's command, which has to be a known one that the client may send, and execute it.

    Args:
        known: the commands by name.
        message: the page's message.
        client: who sent it.
        execute: executes the decoded command; what it raises becomes a sentence.
    """

    def decoded() -> Reply:
        present = present_form(message)
        do = present.get("do")
        kind = known.get(do) if isinstance(do, str) else None
        if kind is None:
            raise OptionError(f"there is no command {quoted(do)}" if do else "the message names no command")
        if client.read_only and not kind.looks:
            raise OptionError(READ_ONLY)
        return execute(kind.decode(present))

    return reply_to(message, decoded)


def reply_to(message: Mapping[str, Any], execute: Callable[[], Reply]) -> Reply:
    """Execute something and return the reply to a message; an error becomes a sentence."""
    number, do = message.get("id"), message.get("do")
    number = number if isinstance(number, int | str) else None
    try:
        return {"reply": number, "ok": True, **execute()}
    except LadarregError as error:
        field = {"field": error.field} if error.field else {}
        return {"reply": number, "ok": False, "error": sentence(str(error)), **field}
    except OSError as error:
        log.warning("%s: %s", do, error)
        reason = f"system error: {(error.strerror or type(error).__name__).lower()}"
        return {
            "reply": number,
            "ok": False,
            "error": sentence(f"{reason}; check the path, its permissions and the free space"),
        }
    except Exception as error:
        log.exception("the command %s failed", do)
        return {"reply": number, "ok": False, "error": internal_error(error, go_on="nothing else is lost, try again")}
