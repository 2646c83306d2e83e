"""The exact scenes by name."""
