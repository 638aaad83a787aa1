"""Simulated drawing in a separate process that is killed."""

from __future__ import annotations

import random
import time
from multiprocessing.connection import Connection
from pathlib import Path

import ladarreg.session.session
import numpy as np
from ladarreg.session.session import Session

from ladarreg_core.matches import Pick
from ladarreg_core.project import edits
from ladarreg_core.project.document import Document
from ladarreg_core.project.history import NOBODY, History
from ladarreg_core.project.source import Source
from ladarreg_core.project.storage.folder import ProjectFolder
from testing.attacks.full_disk import largest_file

WHEN = "2026-01-02T03:04:05+00:00"


def begin(place: Path) -> Session:
    folder = ProjectFolder(place)
    document, _ = edits.with_photo(Document(name="work"), Source(path="photo.png", name="photo.png", size=3))
    history = History.begun(document, label="Begin", author="", when=WHEN)
    folder.begin(history)
    return Session(folder, history, elsewhere=[place.with_name("elsewhere")])


def draw(session: Session, k: int) -> bool:
    """Add a pick, and return whether it was reported as saved."""
    pick = Pick("new", "point", np.array([[1.0, k / 20, 0.1]]), np.array([[100.0 + k, 50.0]]))
    session.commit(
        f"Draw {k}", lambda d: edits.edited_photo(d, "p1", lambda p: edits.with_picks(p, [pick])[0]), author=NOBODY
    )
    return not session.unsaved


def work_until_killed(place: str, seed: int, answers: Connection) -> None:
    """Draw on a disk that is temporarily full, reporting each reply, until this process is killed."""
    ladarreg.session.session.RETRY_S = 0.05
    rng = random.Random(seed)
    session = begin(Path(place))
    log = Path(place) / "history.jsonl"
    k = 0
    while True:
        for _ in range(rng.randrange(1, 6)):
            answers.send((k, draw(session, k)))
            k += 1
        with largest_file(log.stat().st_size + rng.randrange(1, 400)):
            for _ in range(rng.randrange(1, 8)):
                answers.send((k, draw(session, k)))
                k += 1
                time.sleep(rng.choice((0, 0, 0.02)))
        time.sleep(rng.choice((0, 0.07)))
