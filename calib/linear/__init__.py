"""The linearisation: what all rows say at a state, reduced to what a user wants to know.

**Normal equations.** At a state, whitened rows ``A x = b`` (b is minus the residual) are fully
described by the Gram matrix of ``[A | b]``: ``H = A^T A``, ``h = A^T b`` and ``b^T b``. It is a sum
over rows, so each stop's million beams become one small matrix (`rows`), stops side by side on
threads, in processes or on a cluster (`parallel`), and no row is looked at again. A stop's beams
know where the LiDAR is only through its twist, 6 columns; the chain rule, ``d twist / d unknowns``,
is applied to the sums.

**Units.** Every column is scaled by the prior sigma of its unknown. A prior then adds 1 to the
diagonal of what is eliminated, so that its blocks can always be factored, and metres and radians
are comparable. Unknowns without a prior (``unbounded``: candidates of a diagnosis) are not scaled.

**Three kinds of unknowns** (`layout`). *Own* unknowns of a stop, its pose and joint errors, are
touched by that stop alone. *Cells* are displacements of parts of the mesh, of three sizes (surface,
region, patch), and tilts of the larger two. All others, the calibration above all, are *kept*.

**Elimination** (`elimination`) takes own unknowns and cells out by the Schur complement,
``H_kk - H_ke H_ee^-1 H_ek``: what remains says of the kept unknowns exactly what all rows say, and
the gain ``H_ee^-1 H_ek`` leads back to those eliminated. The result does not depend on the order,
the work does, so that with less is chosen (`assembly`). Few stops in a room of many parts: cells
go first, surface by surface, as no beam meets two, and then all that stops have for themselves.
Many stops: these go first, so that no matrix grows with their number. What goes with a stop is the
square of a few rows, six of which are wide, as a stop's beams know the LiDAR by six numbers; rows
of many stops go into one product. Where a stop has no beams, its own rows are turned by QR until
only some of them touch its own unknowns. All cells go at the end, in one block: there are never
many more of them, however large the room.

The `Linearisation` (`system`) that is left holds ``kept``: the normal equations of the kept
unknowns and b, without their priors and without rows that touch kept unknowns only (targets, bodies
whose pose several stops share): `calib.solve.graph` adds those and solves. For tests of what is
missing, ``J^T W b`` is also kept apart for each cluster of rows that err together (`clusters`).

`linearise` is the way in.
"""
