# What the Kalman filters compute, as text that is the same on every runtime: estimates and gains of scalar filters over
# made-up measurements, and the gains that set-up finds for the attitude filter.

from upright.kalman import Kalman6, KalmanFilter

for q, r, turn in (
    (10.0, 0.05, 360000),
    (0.001, 1, 360000),
    (1e-8, 1.0, 360000),
    (0, 2, 1 << 30),
    (1e-10, 1, None),
    (123456, 0.25, 360001),
    (1, 1, 7),
):
    f = KalmanFilter(12345, q, r, turn)
    seed = 1
    total = 0
    for k in range(300):
        seed = (seed * 75 + 74) % 65537
        z = ((seed * 16411 + k * 99991) & 0x3FFFFFFF) - (1 << 29)
        total = (total * 31 + f.update(z)) % 1000003
    print(f.x, f.gain, total, *list(f.state))

for rate in (50, 200, 1000, 8000, (2000, 7)):
    for noise in ((0.001, 2e-7, 20), (0.001, 0.003, 0.03), (2.5e-5, 0, 0.1), (0, 1e-9, 1)):
        print(*list(Kalman6(rate, (82, 5), 4096, *noise).state))
