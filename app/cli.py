"""The command line: `ladarreg COMMAND ...`.

Only the module of the chosen command is imported, and none for `--help`: tyro alone takes a fifth of a second.
"""

from __future__ import annotations

import errno
import gc
import importlib
import io
import os
import sys
from collections.abc import Iterator, Sequence
from typing import NoReturn

from .exit_codes import ExitCode
from .stop_signals import forget_interrupt, interrupt_on_stop_signals

COMMANDS = {
    "register": "Register a scan with a photo: pose, registered image, model.",
    "survey": "Write survey.json of a folder with scans and photos.",
    "adjust": "Solve a survey: scans, photos and cameras together.",
    "batch": "Do many jobs: pairs, photos of a scan, surveys.",
    "audit": "Judge a calibration in use: right, wrong or undecidable.",
    "apply": "Colour and export with a known pose: given, not verified.",
    "compare": "Compare the thesis's stages with the default method.",
    "panorama": "Compose the pieces of a pan/tilt run as one scan.",
    "register-scans": "Register scans of several stations to each other.",
    "targets": "Place a scanner by survey spheres, as a surveyor signs it.",
    "measure": "Measure in a result: lengths, angles, areas, with sigma.",
    "rectify": "Make a view of a wall, pipe or plan at a stated scale.",
    "change": "Compare scans of two dates: what has changed, if any.",
    "export": "Hand results to other programs: COLMAP, E57, LAZ, ROS ...",
    "model": "Make one coloured model of many photos and sensors.",
    "report": "Write the report of a result or project: one HTML file.",
    "info": "Describe a scan, photo, camera, pose, matches or results.",
    "check": "Say whether a project, result, run or export is damaged.",
    "selftest": "Estimate how well a scan and a camera will register.",
    "devices": "List serial ports, and the pan/tilt unit or scanner there.",
    "acquire": "Scan all around: drive pan/tilt unit and scanner by a plan.",
    "simulate": "Write a synthetic scan and photo with their true pose.",
    "serve": "Open the workbench in the browser, on a project or files.",
    "demo": "Open the workbench on the embedded sample.",
}
"""Summary of each command; its code is `commands/<name>.py`."""

_EXAMPLES = ("ladarreg demo", "ladarreg register room.e57 photo.jpg -o results", "ladarreg serve room.e57 photo.jpg")
_LOOKING = ("info", "check", "devices")
_OBJECTS_BEFORE_COLLECTION = 50_000
_MAX_CAUSES = 20  # causes of errors can be circular
_NO_MEMORY = (
    "failed to map segment", "cannot allocate memory",  # a library that is loaded late
    "can't start new thread", "bad_alloc", "insufficient memory",  # the last two: OpenCV
)  # fmt: skip
_INTERRUPTED = "interrupted; no incomplete files are left"
_EXIT_CODES = "Exit codes: 0 accepted, or done; 1 failure; 2 bad input; 3 not accepted; 4 undecidable; 130 interrupted."


def main(args: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code; errors are one line on stderr."""
    words = list(sys.argv[1:] if args is None else args)
    if len(words) > 1 and words[0] == "help" and not words[1].startswith("-"):
        words = [words[1], "--help"]
    if not words or words[0] in ("-h", "--help", "help"):
        print(_help())
        return ExitCode.ACCEPTED if words else ExitCode.BAD_INPUT
    if words[0] == "--version":
        from ladarreg_core import __version__

        print(f"ladarreg {__version__}")
        if "--verbose" in words[1:]:
            from ladarreg_core.formats.isolated import confinement

            for name, state in confinement():
                print(f"confinement of reader processes, {name}: {state}")
        return ExitCode.ACCEPTED
    if words[0] not in COMMANDS:
        return _fail(_no_command(words[0]), ExitCode.BAD_INPUT, as_json="--json" in words)
    debug = "--debug" in words
    interrupt_on_stop_signals()
    try:
        return _run(words[0], words[1:], debug=debug)
    except SystemExit as stop:  # after help
        return stop.code if isinstance(stop.code, int) else ExitCode.ACCEPTED
    except (KeyboardInterrupt, Exception) as error:
        if debug:
            import traceback

            traceback.print_exc()
        return _fail(*_explain(error), as_json="--json" in words)


def entry_point() -> NoReturn:
    """Run `main` and exit; a closed output pipe is not an error."""
    # Threads of NumPy's linear algebra gain nothing on the small products here, and wait for each other where cores are
    # shared. It reads this when it is first imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Imports make hundreds of thousands of objects that stay: the default looks through them 130 times a command.
    gc.set_threshold(_OBJECTS_BEFORE_COLLECTION)
    _open_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # names of files may be bytes of another encoding than its own
            stream.reconfigure(errors="surrogateescape")
    try:
        code = main()
        sys.stdout.flush()
    except BrokenPipeError:
        # The interpreter flushes once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = ExitCode.ACCEPTED
    forget_interrupt()
    gc.freeze()  # the interpreter would look through all objects once more before it gives up their memory
    sys.exit(code)


def _open_closed_streams() -> None:
    """Open the null device in place of standard streams that are closed: files would be opened under their numbers."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", encoding="utf-8", closefd=False))


def _run(name: str, words: list[str], *, debug: bool) -> int:
    from .arguments import parse

    command = importlib.import_module(f".commands.{name.replace('-', '_')}", __package__)
    arguments = parse(command.Arguments, words, prog=f"ladarreg {name}", description=COMMANDS[name])
    _set_up_log(debug=debug)
    if name not in _LOOKING:
        _require_names(words)
    from ladarreg_core.formats.isolated.forked import confined_reads

    with confined_reads():
        return int(command.run(arguments))


def _require_names(words: Sequence[str]) -> None:
    """Refuse names of files that are no text, before the work: results record names.

    Raises:
        OptionError: if a word is not text.
    """
    from ladarreg_core.errors import OptionError
    from ladarreg_core.formats.parsing.untrusted import one_line

    for word in words:
        if not _is_text(word):
            raise OptionError(f"the name {one_line(word)} is not UTF-8, perhaps Latin-1; rename the file or folder")


def _is_text(word: str) -> bool:
    return not any("\ud800" <= c <= "\udfff" for c in word)


def _explain(error: BaseException) -> tuple[str, ExitCode]:
    """Return the message and the exit code of an error."""
    from ladarreg_core.errors import Cancelled, LadarregError, UnsavedError

    if isinstance(error, KeyboardInterrupt | Cancelled):
        return _INTERRUPTED, ExitCode.INTERRUPTED
    if isinstance(error, UnsavedError):
        return str(error), ExitCode.FAILED
    if isinstance(error, LadarregError):
        return str(error), ExitCode.BAD_INPUT
    if isinstance(error, BrokenPipeError):
        raise error
    if any(map(_lacks_memory, _causes(error))):
        return "not enough memory; use a smaller scan or photo, or a machine with more", ExitCode.FAILED
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror or error}; check the path, its permissions and the space", ExitCode.BAD_INPUT
    if isinstance(error, UnicodeEncodeError) and not _is_text(error.object):
        return "the name of a file or folder is not UTF-8, perhaps Latin-1; rename it", ExitCode.BAD_INPUT
    if any(isinstance(cause, KeyboardInterrupt) for cause in _causes(error)):
        return _INTERRUPTED, ExitCode.INTERRUPTED
    what = f"internal error ({type(error).__name__}: {error})"
    report = "run again with --debug and report the traceback with the command"
    return f"{what}: a fault of this program, not of your files; {report}", ExitCode.FAILED


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and those that caused it: Python 3.11 raises others from an interrupt in `__set_name__`."""
    for _ in range(_MAX_CAUSES):
        if error is None:
            return
        yield error
        error = error.__cause__ or error.__context__


def _lacks_memory(error: BaseException) -> bool:
    """Return whether an error of Python or one of its libraries says that there is no memory left."""
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    return isinstance(error, MemoryError) or any(words in str(error).lower() for words in _NO_MEMORY)


def _no_command(word: str) -> str:
    from difflib import get_close_matches

    near = get_close_matches(word.lower(), COMMANDS, n=1)
    wanted = f"did you mean {near[0]}?" if near else f"use one of {', '.join(COMMANDS)}"
    return f"{word!r} is not a command; {wanted} (see ladarreg --help)"


def _fail(text: str, code: ExitCode, *, as_json: bool = False) -> ExitCode:
    from .messages import one_line

    if as_json:
        import json

        print(json.dumps({"error": one_line(text), "exit_code": int(code)}))
    print(f"ladarreg: {one_line(text)}", file=sys.stderr)
    return code


def _help() -> str:
    import shutil
    import textwrap

    columns = max(50, min(shutil.get_terminal_size((80, 24)).columns - 1, 110))
    width = max(map(len, COMMANDS))

    def wrapped(text: str, *, hang: int = 0) -> str:
        return textwrap.fill(text, columns, subsequent_indent=" " * hang)

    lines = [f"  {name:<{width}}  {summary}" for name, summary in COMMANDS.items()]
    return "\n".join(
        [
            "usage: ladarreg [-h] [--version [--verbose]] COMMAND ...",
            "",
            wrapped("Register laser scans with photos taken from another position, and assess the result."),
            "",
            "commands:",
            *lines,
            "",
            "ladarreg help COMMAND lists the options of a command, with examples.",
            wrapped(_EXIT_CODES, hang=2),
            "",
            "examples:",
            *(f"  {example}" for example in _EXAMPLES),
        ]
    )


def _set_up_log(*, debug: bool) -> None:
    import logging
    import warnings

    if debug:
        logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(levelname)s %(name)s: %(message)s")
        logging.getLogger("ladarreg_core").setLevel(logging.DEBUG)
    else:
        warnings.simplefilter("ignore")
        logging.getLogger().addHandler(logging.NullHandler())
