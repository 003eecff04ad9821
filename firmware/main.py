# Runs after boot.py: the application on this board (board.py says which board it is).

import board
from upright_app import app

application = app.App(board)
application.run()
