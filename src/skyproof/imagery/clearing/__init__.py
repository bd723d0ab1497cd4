"""Vehicle-free backgrounds: find, mask, fill, check, show."""
