from .constraint import (
    constrained,
    constraint_of,
    refuse_constraint,
    without_constraint,
)
from .controls import drawn_variables, drift_driven, noise_driven, outcomes
from .controls import step_variables, StepVariables
from .dependence import acts_elementwise, Dependence
from .hamiltonian import evaluated, hamiltonian_terms, has_lifted, IndexedNoise
from .hamiltonian import is_hamiltonian, noise_terms, slow_apart
from .diffrax_langevin import momentum_first
from .friction import FrictionAlong, semidefinite_root
from .langevin import (
    AbstractFriction,
    bath_terms,
    friction_apart,
    langevin_terms,
    split_friction,
)
from .said_twice import check_baths_have_own_noise, check_drifts_differ
from .spins import as_spins, from_spinors, spin_terms, to_spinors
from .structure import additive_fault, check_assertions, check_stratonovich
from .structure import check_structure
from .structure import commuting, constant_fault, Fault, FRICTION
from .structure import separable_fault
from .surface import check_start, constrained_state, Frame, Surface
from .paths import (
    brownian_paths,
    has_shapes,
    has_unknown_law,
    path_keys,
    path_numbers,
    random_paths,
)
from .paths import replace_paths, shapes_as_paths, specified, with_keys, with_paths
from .truncation import needs_truncation, without_truncation
from .vector_fields import apply, apply_one, check_fit, flattened
from .vector_fields import number_of_noises, rate
from .vector_fields import split_terms, tree_sum
from .waves import from_pair, to_pair, wave_terms
