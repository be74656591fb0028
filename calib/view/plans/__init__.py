"""Plans of stops, as the workbench shows them."""
