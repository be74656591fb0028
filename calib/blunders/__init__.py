"""Groups of rows that a mishap spoiled: each held against what all other rows say."""
