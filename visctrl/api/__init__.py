"""The Python interface: run, step by step, teach, replay and study, as the command line does.

Every name here can be had from `visctrl` itself. The functions take what the options of the
commands of the same names take; `settings` are ``--set``: dotted keys and their values.
"""

from visctrl.api.functions import replay, run, session, study, teach
from visctrl.api.results import Errors, Run
from visctrl.api.stepping import Session

__all__ = ["Errors", "Run", "Session", "replay", "run", "session", "study", "teach"]
