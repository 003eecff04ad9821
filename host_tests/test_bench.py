"""The benchmark's own workings: what it counts, what it subtracts, and that it runs what it says. No times."""

import importlib.util
import sys

import pytest
from conftest import require
from upright.fixmath import euler
from upright.mahony import Mahony6, Mahony9
from upright_host import bench, tracing


def log(*lines):
    return "".join(line + "\n" for line in lines).encode()


TRACE = "Trace 0: 0x7fb020000100 [00000480/000000004081f8c0/00000000/00000200] "
LOG = log(
    TRACE, "what the program prints", TRACE, "@begin a 0", TRACE, "@end a 0", "@begin a 2",
    *[TRACE] * 7, "Linking TBs", "@end a 2", TRACE,
)  # fmt: skip


@pytest.mark.parametrize("size", [1, 7, 64, 10**6])
def test_instructions_are_counted_between_marks_however_the_log_is_cut(size):
    blocks = [LOG[i : i + size] for i in range(0, len(LOG), size)]
    marks = list(tracing.count_traces(blocks))
    assert marks == [("begin a 0", 2), ("end a 0", 3), ("begin a 2", 3), ("end a 2", 10)]


def test_what_is_not_a_steps_is_taken_off():
    marks = [
        ("begin a 0", 5),
        ("end a 0", 15),
        ("begin a 4", 20),
        ("end a 4", 70),
    ]
    assert tracing.per_step(marks) == {"a": (50 - 10) / 4}


def test_loop_and_bus_are_subtracted():
    parts = [part for part in bench.PARTS if part != "collected"]
    spent = {"empty": 1.0, "bus_read": 11.0, "bus_write": 21.0} | dict.fromkeys(parts, 101.0)
    calls = dict.fromkeys(parts, (0, 0)) | {"tick": (1, 2)}
    net = bench.net(spent, calls)
    assert net["filter"] == 100
    assert net["tick"] == 100 - 10 - 2 * 20


@pytest.fixture
def expected(monkeypatch):
    """What 40 steps must come to: the same samples straight into the filter, under CPython."""
    monkeypatch.setattr(sys, "argv", ["bench_steps.py", "alloc", "1", "filters"])  # prints nothing
    spec = importlib.util.spec_from_file_location(
        "steps_for_test", bench.PROGRAMS / "bench_steps.py"
    )
    steps = importlib.util.module_from_spec(spec)
    monkeypatch.setattr(sys, "path", list(sys.path))
    spec.loader.exec_module(steps)

    def run(samples, kind=Mahony6, rows=steps.ROWS):
        filter = kind(200, (82, 5), 4096, steps.KP, steps.KI)
        filter.seed(rows[0])
        for counts in samples(rows):
            filter.update(counts)
        return filter

    by_turns = run(lambda rows: [rows[i & 15] for i in range(40)])
    angles = [0, 0, 0]
    euler(by_turns.state[by_turns.QUATERNION :], angles)
    nine = run(lambda rows: [rows[i & 15] for i in range(40)], Mahony9, steps.ROWS_9)
    same = run(lambda rows: [rows[3]] * 40)
    # body x y z is y -x z of the IMU, x y -z of the magnetometer
    ax, ay, az, gx, gy, gz = steps.ROWS_9[7][:6]
    mx, my, mz = steps.ROWS_9[0][6:9]
    return {
        "filter": list(by_turns.state[by_turns.QUATERNION :][:4]),
        "filter9": list(nine.state[nine.QUATERNION :][:4]),
        "calibration": [ay, -ax, az, gy, -gx, gz, mx, my, -mz, -521, 1],
        "euler": angles,
        "read": list(steps.ROWS[3]),
        "tick": [*same.state[same.QUATERNION :][:4], 40, 40, 0, 0],
        "faults": [0] * 5,
    }


def test_every_runtime_runs_the_steps_and_gets_what_the_filter_gives(runtime, portable, expected):
    got = {}
    for line in portable(runtime, bench.PROGRAMS / "bench_steps.py", "check", 40).splitlines():
        name, *numbers = line.split()
        got[name] = [int(n) for n in numbers]
    floats = got.pop("float")
    # the tick's sample changes by a count from read to read: one that never does is none
    tick, steady = got.pop("tick"), expected.pop("tick")
    assert tick[:4] == pytest.approx(steady[:4], abs=5000) and tick[4:] == steady[4:]
    assert got == expected
    # the float filter is given the same work: its attitude is the same to a degree
    scale = 1000 / (1 << 29)
    assert floats == pytest.approx([q * scale for q in got["filter"][:3]], abs=9)


def test_the_modes_that_measure_run_on_every_runtime(runtime):
    assert set(bench.microseconds(runtime, lines=1)) == {
        *bench.PARTS,
        "empty",
        "bus_read",
        "bus_write",
    } - {"collected"}
    calls = bench.bus_calls(runtime)
    assert calls["read"] == (1, 0)
    assert calls["display"] == (0, 2)
    assert calls["filter"] == (0, 0)
    assert calls["tick"] == (1.125, 2)  # and every eighth tick one register is looked at


def test_only_the_float_filter_allocates(micropython_runtime):
    taken = bench.allocated(micropython_runtime)
    if not taken:
        pytest.skip(f"runtime {micropython_runtime}: it does not tell what is allocated")
    assert taken.pop("float") > 500
    assert set(taken.values()) == {0}


def test_a_run_that_fails_says_so():
    with pytest.raises(tracing.TraceError, match="no_such_mode on cpython failed"):
        bench.say("cpython", "no_such_mode", 1)


@pytest.mark.slow
def test_the_integer_filter_takes_far_fewer_instructions_even_if_garbage_were_never_collected():
    """A guard against falling back; the ten times of a program that runs are for `upright bench` to show."""
    require("arm")
    try:
        found = bench.instructions(16, filters_only=True)
    except bench.runtimes.Unavailable as why:
        pytest.skip(f"runtime arm: {why}")
    filter, floats = (found[part] - found["empty"] for part in ("filter", "float"))
    print(f"filter {filter:.0f}, float {floats:.0f} instructions a step")
    assert filter < 6800
    assert floats >= 8.5 * filter


def figures(ratio):
    costs = dict.fromkeys(bench.PARTS, 100.0) | {"collected": 100.0 * ratio}
    return bench.Figures(
        instructions=costs,
        allocated={"arm": costs},
        cycles=costs,
        not_here=["microseconds on unix: not measured: no such port"],
    )


def test_figures_are_put_between_their_marks_and_nothing_else_changes(tmp_path):
    file = tmp_path / "page.md"
    file.write_text(f"before\n{bench._BEGIN}\nold\n{bench._END}\nafter\n")
    bench.save(figures(12), file)
    bench.save(figures(13), file)
    text = file.read_text()
    assert text.startswith(f"before\n{bench._BEGIN}\n")
    assert text.endswith(f"{bench._END}\nafter\n")
    assert "13.0 times fewer" in text
    assert "12.0" not in text
    assert "old" not in text
    assert "not measured: no such port" in text
    assert "emulated RP2040" in text
    file.write_text("no place\n")
    with pytest.raises(ValueError, match="no place for the figures"):
        bench.save(figures(12), file)


@pytest.mark.slow
@pytest.mark.parametrize(("ratio", "code"), [(9.9, 1), (10.1, 0)])
def test_the_command_fails_below_the_ratio_asked_for(upright, monkeypatch, ratio, code):
    monkeypatch.setattr(bench, "measure", lambda: figures(ratio))
    done = upright("bench")
    assert done.exit_code == code, done.output
    assert f"{ratio} times fewer" in done.output
