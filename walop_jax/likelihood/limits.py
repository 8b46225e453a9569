"""Sizes of the work: how much is computed together, kept in memory or looked at, and why just so much.

Nothing here changes results, only the pieces of a computation, or how large a part of a set stands for all of it.
"""

from __future__ import annotations

# ------------------------------------------------------------------------------------- batches and parts of a set

BATCH = 16
"""Field points whose optics are solved together, for a set as for nodes: what 144 of them need at a time leaves the
cache of the processor and takes twice as long. One program serves sets of any size."""
FORWARD_BATCH = 8
"""The same in the forward model: a gradient of few compiles in two thirds of the time of one of many."""
ACCELERATOR_BATCH = 512
"""The same where thousands of threads have to be kept busy: 40 MB of optics for a gradient."""
LARGE_BATCH = 1024
"""Field points whose optics are interpolated: each of them costs less, and the engine divides it further."""
PARTS = 16
"""A set is cut into so many parts at least, if it has as many batches: work for several threads."""

# ---------------------------------------------------------------------------------------- within one batch

JACOBIAN_BLOCK = 64
"""Field points whose Jacobians are worked on together: these stay in the processor's cache."""
RESPONSES_TOGETHER = 16
"""Field points whose responses are computed together: one program serves sets of any size."""
RESPONSES_AT_ONCE = 4
"""Those of them that are worked on at a time: their derivatives stay in the processor's cache, and take two fifths of
the time."""
RESPONSES_KEPT = 1280
"""Largest number of field points whose responses are kept for further columns: 250 MB. A verdict looks at so many in 16
exposures, three times."""
FRINGES_KEPT = 256
"""The same for slopes in the fringes of air, which one list of candidates asks for once: 100 KB a point."""
RESPONSE_NUMBERS = 4_000_000
"""Numbers of responses that meet the exposures of some points together: 32 MB."""

# ------------------------------------------------------------------------------- optics on nodes of the field

NODES_PER_SIDE = (12, 16, 18, 20, 24, 28, 32)
"""Numbers of nodes per side that are tried in turn: two more gain a factor of 30, beyond 32 the optics oscillate."""
CHECKED_PLACES = 48
"""Places between the nodes at which the error is measured: within a factor of three of the largest anywhere."""

# ------------------------------------------------------------------------------------------------- large sets

INTERPOLATE_ABOVE = 4096
"""Field points above which the optics are interpolated: more than ten times the nodes that they need."""
LARGE_ABOVE = 65536
"""Field points above which a fit begins with a sample, and does with as few passes as can be: one takes seconds."""
SAMPLE = 16384
"""Field points of a large set on which its fit begins: a fit of these takes as long as a pass or two of the set."""
FARTHEST = 32
"""Points of a set for each one of its sample at most: the minima are then some six standard errors apart, and a step
leaves a thousandth of that."""
MEDIAN_POINTS = 65536
"""Field points that the median of the counts is taken of: its error is then half a per cent of the scatter."""
MEDIAN_RUN = 4096
"""Field points that are looked at together for the median."""
NEIGHBOURS = 256
"""Points of a sample that lie side by side: a block of a table costs as much for one of them as for a row."""
BLOCKS = (16, 128)
"""Smallest and largest number of blocks of neighbours in a sample: spread over the field, yet few to read."""

# ------------------------------------------------------------------------------------------- after the fit


MATRIX_POINTS = 32
"""Field points whose matrices or analysis vectors are computed together, for one star as for a map: one program."""
MAP_PLACES = 2000
"""Places at which derivatives of the matrix are asked of a model once it is fitted, in maps and errors: so many are
worth an optimised program of the optics, 0.4 ms a place instead of 2.4 ms."""

# ------------------------------------------------------------------------------------------------- diagnosis

DIAGNOSED_ROWS = 100_000
"""(Exposure, point) pairs that a diagnosis looks at: 800 columns of four cameras each take 2.5 GB."""
DIAGNOSED_NUMBERS = 120_000_000
"""Numbers that the columns of a diagnosis may hold: 1 GB, of which there are four copies at most."""
OPTIMISED_ABOVE = 6000
"""(Exposure, point) pairs above which programs are optimised: they are compiled in three times the time, and run in a
third of it."""
OFTEN_OPTIMISED_ABOVE = 1500
"""The same for derivatives of optics and residuals, which a fit asks for some ten times."""
SELDOM_OPTIMISED_ABOVE = 15_000
"""The same for responses, which one likelihood asks for once: an optimised program takes 6 s more to compile, and saves
0.1 s for 16 points."""
FREE_EXPOSURES = 100
"""Exposures of a set up to which a free-form term may have a number for each camera in each of them."""
PRODUCT_ROWS = 2048
"""Rows of columns that are projected and multiplied together: a copy of them is small beside all."""
COLUMNS_TOGETHER = 256
"""Columns that are multiplied together: large enough for the full speed of a core, small enough to share them out."""
AMPLITUDES_AT_ONCE = 32
"""Amplitudes that are differentiated together: hundreds of them at all exposures of several points take gigabytes."""
