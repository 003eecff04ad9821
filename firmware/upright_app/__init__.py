# The application that a board boots: see app.py.
