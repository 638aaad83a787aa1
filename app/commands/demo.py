"""`ladarreg demo`."""

from __future__ import annotations

from dataclasses import dataclass

from app.exit_codes import ExitCode


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """What `demo` is told."""

    port: int = 8080
    """Port on this machine; a busy one is replaced by the next."""
    no_browser: bool = False
    """Only print the address."""
    quiet: bool = False
    """No progress."""
    debug: bool = False
    """Log, and a trace back where something fails."""


def run(arguments: Arguments) -> ExitCode:
    """Register the sample, show it until Ctrl-C."""
    from app.demo import run_demo

    return run_demo(port=arguments.port, browser=not arguments.no_browser, quiet=arguments.quiet)
