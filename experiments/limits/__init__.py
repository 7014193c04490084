"""Physical limits of lane changes and laps, by optimal control, and the table that is shipped.

`limit_of` looks a limit up without CasADi; `compute` finds it.
"""

from experiments.limits.table import Limit, LimitCase, limit_of

__all__ = ["Limit", "LimitCase", "limit_of"]
