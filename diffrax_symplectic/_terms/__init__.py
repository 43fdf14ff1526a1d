from ._constraint import constraint_of, refuse_constraint, without_constraint
from ._controls import controls, drift_driven, noise_driven, outcomes, step_variables
from ._dependence import acts_elementwise, Dependence
from ._hamiltonian import evaluated, hamiltonian_terms, has_lifted, IndexedNoise
from ._hamiltonian import is_hamiltonian, shapes_as_paths
from ._diffrax_langevin import momentum_first
from ._friction import FrictionAlong
from ._langevin import bath_terms, friction_apart, langevin_terms, split_friction
from ._spins import as_spins, from_spinors, spin_terms, to_spinors
from ._structure_checks import additive_fault, check_stratonovich, check_structure
from ._structure_checks import commuting, constant_fault, Fault, FRICTION
from ._structure_checks import separable_fault, WRONG_WAY_ROUND
from ._surface import check_start, constrained_state, Surface
from ._vector_fields import apply, apply_one, brownian_paths, check_fit, flattened
from ._vector_fields import number_of_noises, path_numbers, rate, replace_paths
from ._vector_fields import split_terms, tree_sum
from ._waves import from_pair, to_pair, wave_terms
