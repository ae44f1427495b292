"""Measured joint data against a simulated asset: what differs, and why.

    from diagnose import diagnose
    result = diagnose("model.xml", ["run1.csv", "run2.csv", "run3.csv"], joint="hinge")
    result.verdict, result.causes, result.data
    result.write("out")
"""

from diagnose.diagnosis import Diagnosis, diagnose
from diagnose.log import JointLog, LogError, load_log

__all__ = ["Diagnosis", "JointLog", "LogError", "diagnose", "load_log"]
