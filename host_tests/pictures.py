"""What a drawn figure shows, as numbers."""

import numpy as np


def line_of(panel, k):
    """What the k-th line of a panel shows, without its gaps."""
    t, y = (np.asarray(v, float) for v in panel.get_lines()[k].get_data())
    return t[np.isfinite(y)], y[np.isfinite(y)]
