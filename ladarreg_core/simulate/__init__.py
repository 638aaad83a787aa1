"""A synthetic LADAR and camera: rooms by seed with the true pose, and the sample that is shipped with the package."""

from ladarreg_core.simulate.case import SETS as SETS
from ladarreg_core.simulate.case import CaseSet as CaseSet
from ladarreg_core.simulate.case import SimulatedCase as SimulatedCase
from ladarreg_core.simulate.case import simulate_case as simulate_case
from ladarreg_core.simulate.case import write_case as write_case
from ladarreg_core.simulate.scenes import SCENES as SCENES
