"""How robust is an overhead vehicle detector to camouflage that could be painted or built?

`import skyproof as sp` gives the names that programs need. They are listed once, in
`__init__.pyi`, and loaded at their first use, so that importing the package costs next to nothing.
"""

import lazy_loader

__version__ = "0.2.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
