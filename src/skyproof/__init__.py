"""How robust is an overhead vehicle detector against camouflage that could really be painted or built?"""

__version__ = "0.1.0"
