"""Is this installation sound, and is this dataset sound beyond its bytes? ``navrep-data doctor [DIR]``.

It loads torch only to see that it can be loaded.
"""

from navrep_data.doctor.dataset import DatasetFinding, DatasetReport, check_dataset
from navrep_data.doctor.installation import Finding, check_installation

__all__ = ["DatasetFinding", "DatasetReport", "Finding", "check_dataset", "check_installation"]
