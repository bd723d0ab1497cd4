"""Rates of counted pairs, how sure they are, and how many vehicles a test needs.

Except for planning, the functions take counts as arrays and know no file, image or camouflage.
"""
