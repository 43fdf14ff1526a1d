from ._controls import (
    drift_driven as drift_driven,
    noise_driven as noise_driven,
    controls as controls,
    outcomes as outcomes,
    step_variables as step_variables,
)
from ._hamiltonian import (
    hamiltonian_terms as hamiltonian_terms,
    IndexedNoise as IndexedNoise,
    is_hamiltonian as is_hamiltonian,
    Lifted as Lifted,
)
from ._spins import (
    as_spins as as_spins,
    from_spinors as from_spinors,
    spin_terms as spin_terms,
    to_spinors as to_spinors,
)
from ._structure_checks import (
    additive_fault as additive_fault,
    check_stratonovich as check_stratonovich,
    check_structure as check_structure,
    commuting as commuting,
    constant_fault as constant_fault,
    FRICTION as FRICTION,
    separable_fault as separable_fault,
)
from ._vector_fields import (
    apply as apply,
    apply_one as apply_one,
    brownian_paths as brownian_paths,
    number_of_noises as number_of_noises,
    replace_paths as replace_paths,
    split_terms as split_terms,
    tree_sum as tree_sum,
)
from ._waves import (
    from_pair as from_pair,
    to_pair as to_pair,
    wave_terms as wave_terms,
)
