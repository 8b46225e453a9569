"""`python -m walop_jax`: the program."""

from __future__ import annotations

from walop_jax.commands import main

if __name__ == "__main__":
    main()
