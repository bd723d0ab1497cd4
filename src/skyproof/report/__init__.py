"""Results as one self-contained HTML page, with tables and pictures.

No statistics are done here, and no torch is imported.
"""
