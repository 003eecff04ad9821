# Starts the application on this board (board.py says which board it is).

import upright  # noqa: F401, I001  first: it finishes an installation that was cut off

from upright_app import app

application = app.App()
application.run()
