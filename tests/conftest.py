"""Double precision for every test: the package itself never switches it on."""

import jax

jax.config.update("jax_enable_x64", True)
