import jax


# Before any module makes an array.
jax.config.update("jax_enable_x64", True)
