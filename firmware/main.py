# Runs after boot.py: the application on this board (board.py says which board it is).

import app
import board

application = app.App(board)
application.run()
