"""What of a run a page shows: stops and columns, on which scale, in which colours; and how far its
rig stands from CAD."""
