"""Python imports this at its start where the folder is on PYTHONPATH: blocks the processes that tests start."""

import loopback_only

loopback_only.install()
