"""A synthetic LADAR and camera: rooms by seed with the true pose, and the sample that is shipped with the package."""

from typing import TYPE_CHECKING

from ladarreg_core.simulate.case import SETS as SETS
from ladarreg_core.simulate.case import CaseSet as CaseSet
from ladarreg_core.simulate.case import SimulatedCase as SimulatedCase
from ladarreg_core.simulate.case import simulate_case as simulate_case
from ladarreg_core.simulate.case import write_case as write_case
from ladarreg_core.simulate.worlds.scenes import SCENES as SCENES

if TYPE_CHECKING:
    from ladarreg_core.simulate.sample import sample_folder as sample_folder


def __getattr__(name: str) -> object:
    # Imported on demand, so that `python -m ladarreg_core.simulate.sample` does not load that module twice.
    if name == "sample_folder":
        from ladarreg_core.simulate.sample import sample_folder

        return sample_folder
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
