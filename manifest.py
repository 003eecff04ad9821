# Freezes Upright's library into a MicroPython firmware: FROZEN_MANIFEST=.../manifest.py, or include() this file in a
# board's own manifest. freeze() takes what lies in lib/, so that a new module needs no line here.

freeze("lib")  # noqa: F821  a name that MicroPython's build gives to manifests
