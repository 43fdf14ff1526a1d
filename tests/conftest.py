import jax
import pytest


jax.config.update("jax_enable_x64", True)


@pytest.fixture(autouse=True, scope="module")
def free_compiled_programs():
    """Thousands of programs in one process exhaust its memory mappings, and XLA crashes."""
    yield
    jax.clear_caches()
