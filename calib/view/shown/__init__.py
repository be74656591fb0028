"""What of the beams a page shows: which stops, which columns, on which scale, in which colours."""
