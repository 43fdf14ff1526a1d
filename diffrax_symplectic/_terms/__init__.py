"""What the equation is: vector fields from Hamiltonians, their structure, and the Brownian
paths that they hold.

What users call:

- `hamiltonian`: `hamiltonian_terms` and `noise_terms`.
- `langevin`: `langevin_terms` and `bath_terms`; a folder.
- `spins`, `waves`: `spin_terms` and `wave_terms`, for Hamiltonians of another variable.
  `lifted` makes Hamiltonians of `(p, q)` from these.
- `ito`: `ito_drift`, for noise in the sense of Ito.
- `constraint`: `constrained_state`, and the surface of the positions that a constraint
  allows; a folder.

What solvers and expectations ask of terms, from the bottom up:

- `paths`: the Brownian paths that terms hold.
- `dependence`: which inputs the results of a function depend on.
- `evaluation`: calls of the user's functions, with advice on their errors.
- `callers`: which functions of the user terms hold, and traced programs in their place.
- `constrained_drift`: the drift of a system with a constraint.
- `symplectic_gradients`: the vector fields of Hamiltonians.
- `drift_and_noise`: which terms are drifts, which are noises, and drifts split into energy,
  friction and slow potential.
- `vector_fields`: vector fields times controls.
- `step_variables`: the random variables of a step and their laws.
- `structure`: whether a system has the structure that a solver needs, and what is wrong
  with it; a folder.
"""

from .callers import with_programs
from .constrained_drift import check_unconstrained, constraint_of
from .constrained_drift import with_constraint, without_constraint
from .constraint import check_start, constrained_state, NormalSpace, Surface
from .dependence import acts_elementwise, Dependence
from .drift_and_noise import control_struct, field_of, friction_apart, number_of_noises
from .drift_and_noise import slow_apart, split_friction, split_terms
from .evaluation import call_user_function, NEED_VALUES
from .hamiltonian import hamiltonian_terms, noise_terms
from .ito import ito_drift
from .langevin import bath_terms, BathNoise, FrictionAlong, langevin_terms
from .langevin import momentum_first, semidefinite_root
from .lifted import has_lifted
from .paths import brownian_paths, has_unknown_law, motion_numbers, path_keys
from .paths import random_paths, replace_paths, shapes_as_paths, which_are_shapes
from .paths import with_keys, with_paths, with_paths_for_shapes
from .spins import as_spins, from_spinors, spin_terms, to_spinors
from .step_variables import outcomes, step_variables, StepVariables
from .structure import additive_fault, check_assertions, check_baths_have_own_noise
from .structure import check_drifts_differ, check_stratonovich, check_structure
from .structure import constant_fault, Fault, FRICTION, noises_commute
from .structure import separable_fault
from .structure import which_need_truncation, with_truncation
from .symplectic_gradients import AbstractFriction, IndexedNoise
from .vector_fields import apply, apply_one, check_terms_fit_state, rate, tree_sum
from .waves import from_pair, to_pair, wave_terms
