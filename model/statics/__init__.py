"""Statics: available wrenches, dexterity, and tension distribution.

Pure functions of arrays. One sign convention holds everywhere: ``structure_matrix @ tensions +
external_wrench = 0``, where gravity is part of the external wrench. A wrench is three forces
[N], then three moments [N·m] about the platform origin, in the world frame.
"""

from __future__ import annotations
