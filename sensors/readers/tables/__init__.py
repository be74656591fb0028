"""Tables of anyone's: how cells are separated, what their units are, what their columns mean."""
