"""Sizes of the work: how much is computed together, kept in memory or looked at, and why just so much.

Nothing here changes what is computed, only in what pieces, or how large a part of a set stands for all of it.
"""

from __future__ import annotations

# ------------------------------------------------------------------------------------- chunks, slabs, memory

POINTS_PER_CHUNK = 16
"""Field points of a chunk whose optics are solved point by point: what 144 of them need at a time leaves the cache of
the processor and takes twice as long. One program serves sets of any size."""
FORWARD_CHUNK = 8
"""Field points of a chunk of the forward model: a gradient of few compiles in two thirds of the time of one of many."""
FORWARD_CHUNK_OF_ACCELERATORS = 512
"""The same where thousands of threads have to be kept busy: 40 MB of optics for a gradient."""
LARGE_CHUNK = 1024
"""Field points of a chunk whose optics are interpolated: each of them costs less, and the engine divides it further."""
MEMORY = 2e9
"""Bytes that point data may take unless told otherwise: half of them for a set that is kept, all for one read anew."""
READING = 5
"""Bytes that reading takes for a moment, times those of the slab: the file, its float64, masks and a copy or two."""
LARGEST_SLAB = 1 << 26
"""Bytes of point data that are read together at most: larger slabs are no faster."""
SLABS = 16
"""A set is cut into so many slabs at least, if it has as many chunks: work for several threads."""

# ---------------------------------------------------------------------------------------- within one chunk

JACOBIAN_BLOCK = 64
"""Field points whose Jacobians are worked on together: these stay in the processor's cache."""
COLUMNS = 256
"""Columns of an image row that are worked on together: the sums of four cameras and 25 exposures take a megabyte."""
RESPONSES_TOGETHER = 32
"""Field points whose responses are computed together: one program serves sets of any size."""
RESPONSE_NUMBERS = 4_000_000
"""Numbers of responses that meet the exposures of some points together: 32 MB."""

# ------------------------------------------------------------------------------- optics on nodes of the field

NODES_PER_SIDE = (12, 16, 18, 20, 24, 28, 32)
"""Numbers of nodes per side that are tried in turn: two more gain a factor of 30, beyond 32 the optics oscillate."""
CHECKED_PLACES = 48
"""Places between the nodes at which the error is measured: within a factor of three of the largest anywhere."""
SOLVED_TOGETHER = 16
"""Places whose optics are solved together, so that they are compiled for one size only."""

# ------------------------------------------------------------------------------------------------- large sets

INTERPOLATE_ABOVE = 4096
"""Field points above which the optics are interpolated: more than ten times the nodes that they need."""
LARGE_ABOVE = 65536
"""Field points above which a fit begins with a sample, and does with as few passes as can be: one takes seconds."""
SAMPLE = 16384
"""Field points of a large set on which its fit begins: a fit of these takes as long as a pass or two of the set."""
PIXEL_SAMPLE = 1024
"""Pixels of whole frames on which their fit begins: the optics of so few are soon solved one by one."""
FIRST_STRIPS = 8
"""Strips of image rows that are fitted before all of them: twice what a throughput of fourth order asks for."""
FARTHEST = 32
"""Points of a set for each one of its sample at most: the minima are then some six standard errors apart, and a step
leaves a thousandth of that."""
CELLS = 128
"""Cells of whole frames along the longer side in which pixels are summed: 1.5 MB for each exposure."""
COMPRESSED_BLOCKS, COMPRESSED_POINTS = 6, 4
"""Blocks of cells, and points of a block, along a side of frames that are compressed."""
STRIP_ROWS = 32
"""Image rows, at least, that are read together."""
MEDIAN_POINTS = 65536
"""Field points that the median of the counts is taken of: it is then known to half a per cent of its scatter."""
MEDIAN_SLAB = 4096
"""Field points that are read together for the median: whole rows of a frame."""
NEIGHBOURS = 256
"""Points of a sample that lie side by side: frames are read in rows, and single pixels cost as much as a row."""
RUNS = (16, 128)
"""Smallest and largest number of runs of neighbours in a sample: spread over the field, yet few to read."""
LEVEL_POINTS = 256
"""Field points from which the start value of a throughput is taken: a start need not be exact."""

# ------------------------------------------------------------------------------------------- after the fit

MISFIT_POINTS = 65536
"""Field points whose residuals are grouped to describe a misfit: their cube then takes 50 MB at 25 exposures."""
ROBUST_POINTS = 4096
"""Field points whose residuals give the errors of a fit that does not explain its data."""
POINTS_PER_CELL = 64
"""Field points of a cell of the residual map: its errors are an eighth of those of a point."""
MOST_CELLS = 128
"""Cells of the residual map along a side: 32 × 32 pixels each for a detector of 4096 pixels."""

MATRIX_POINTS = 32
"""Field points whose matrices or analysis vectors are computed together, for one star as for a map: one program."""
MATRICES_ONCE = 256
"""Field points up to which programs of matrices and their derivatives are compiled without optimisation."""

# ------------------------------------------------------------------------------------------------- diagnosis

DIAGNOSED_ROWS = 100_000
"""(Exposure, point) pairs that a diagnosis looks at: 800 columns of four cameras each take 2.5 GB."""
TRUST_ROWS = 20_000
"""(Exposure, point) pairs whose residuals are searched for patterns after every fit: a second, and half a GB."""
DIAGNOSED_NUMBERS = 120_000_000
"""Numbers that the columns of a diagnosis may hold: 1 GB, of which there are four copies at most."""
COMPILED_ONCE = 6000
"""(Exposure, point) pairs up to which columns of effects, counts and residuals are compiled without optimisation."""
DERIVATIVES_ONCE = 1500
"""The same for derivatives of residuals, which a fit asks for some ten times: they run three times as long then."""
FITTED_FROM_ROWS = 20_000
"""(Exposure, point) pairs of a set up to which the matrix of a fit is made from its rows, by a program that errors and
trust need anyway: to compile or to load another one takes longer. The rows take 100 MB at most."""
CHOICE_ROWS = 6000
"""(Exposure, point) pairs on which other descriptions of an instrument are compared before any of them is fitted."""
MANY_POINTS = 4
"""Field points of an exposure, on average, above which its cameras may have gains of their own: with fewer there are
nearly as many gains as data."""
FREE_EXPOSURES = 100
"""Exposures of a set up to which a free-form term may have a number for each camera in each of them."""
PRODUCT_ROWS = 4096
"""Rows of columns that are projected and multiplied together: a copy of them is small beside all."""
COLUMNS_TOGETHER = 256
"""Columns that are multiplied together: large enough for the full speed of a core, small enough to share them out."""
AMPLITUDES_AT_ONCE = 32
"""Amplitudes that are differentiated together: hundreds of them at all exposures of several points take gigabytes."""
NULL_DRAWS = 1_000
"""Draws of all scores under the base model: a fifth of them give the number of trials to 7 %."""
MANY_SHAPES = 8
"""Shapes of an effect above which one of them, of the median size, stands for all in what it does to the matrix."""

# --------------------------------------------------------------------------------------------------- science

STAR_ROWS = 16384
"""Rows of a star catalogue that are worked on together: their matrices take some MB."""
STAR_SAMPLE = 16384
"""Rows of a catalogue, spread over it, by which the whole of it is judged: they see a camera that has changed by a
fiftieth of what single stars of 10⁶ electrons would show."""
WATCHED_ROWS = 200_000
"""Rows of catalogues by which a calibration is watched: a kilobyte each, and a camera is seen to 10⁻⁵."""
CHECKED_ROWS = 2048
"""Rows whose columns for the check of a catalogue are worked on together: a hundred columns of them take 7 MB."""
