# Freezes Upright, library and application, into a MicroPython firmware: FROZEN_MANIFEST=.../manifest.py, or include()
# this file in a board's own manifest. Frozen modules use no file system, and are found before files.

package("upright", base_path="lib", opt=2)  # noqa: F821  names that MicroPython's build gives to manifests
package("upright_app", base_path="firmware", opt=2)  # noqa: F821
