"""Rates of counted pairs, how sure they are, and how many vehicles a test needs.

These functions take counts as arrays and know of no file, image or camouflage.
"""
