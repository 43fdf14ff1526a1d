from .base import AbstractSymplecticRungeKutta as AbstractSymplecticRungeKutta
from .midpoint import Midpoint as Midpoint
from .srks1 import SRKs1 as SRKs1
from .srkw1 import SRKw1 as SRKw1
from .srkw2 import SRKw2 as SRKw2
