from ._terms import (
    brownian_paths as brownian_paths,
    split_terms as split_terms,
    tree_sum as tree_sum,
)
from .base import AbstractSymplecticRungeKutta as AbstractSymplecticRungeKutta
from .midpoint import Midpoint as Midpoint
from .srks1 import SRKs1 as SRKs1
from .srks2 import SRKs2 as SRKs2
from .srks3 import SRKs3 as SRKs3
from .srks4 import SRKs4 as SRKs4
from .srkw1 import SRKw1 as SRKw1
from .srkw2 import SRKw2 as SRKw2
from .srkw3 import SRKw3 as SRKw3
from .srkw4 import SRKw4 as SRKw4
from .srkw5 import SRKw5 as SRKw5
from .levy_area_midpoint import LevyAreaMidpoint as LevyAreaMidpoint
from .ninomiya_victoir import NinomiyaVictoir as NinomiyaVictoir
from .strang_gauss import StrangGauss as StrangGauss
from .additive_gauss import AdditiveGauss as AdditiveGauss
from .plateau_verlet import PlateauVerlet as PlateauVerlet
from .stormer_verlet import StormerVerlet as StormerVerlet
