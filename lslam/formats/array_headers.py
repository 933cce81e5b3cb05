"""One thread at a time reads NumPy's headers.

NumPy parses them as Python, and CPython 3.11 counts the depth of its parser for all threads together: where a collection of
garbage lets another one in, the first ends with a SystemError (CPython issue 106905).
"""

from __future__ import annotations

from threading import RLock

HEADERS = RLock()
