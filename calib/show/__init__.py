"""What people read: tables of the terminal and of notebooks."""
