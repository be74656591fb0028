"""The linearisation: what all rows say at a state, as sums, and its elimination down to what a
user wants to know."""
