"""Reads imagery, cuts it into tiles and removes their vehicles. Also reads labels of all forms."""
