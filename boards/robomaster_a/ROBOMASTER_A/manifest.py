# What is part of the firmware itself: only the port's own modules. The project's library goes to the file system: a
# frozen module would come before a newer one in /lib.
# ruff: noqa: F821  (include is the port's)

include("$(PORT_DIR)/boards/manifest.py")
