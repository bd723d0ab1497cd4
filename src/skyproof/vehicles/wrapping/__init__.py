"""Real meshes are brought onto the shared template here: read, turned, laid around, baked, judged.

Nothing of it is needed where a fleet is only used.
"""
