"""Progress is told again after silence, with how long it has been."""

import threading
import time

from walop_jax.io.progress import repeated


def test_silence_is_broken_and_ends_with_the_work():
    told: list[str] = []
    before = threading.active_count()
    with repeated(told.append, every=0.15) as say:
        say("compiling")
        time.sleep(0.5)
        say("next")
    count = len(told)
    assert told[0] == "compiling"
    assert told[1].startswith("compiling, 0 s so far")
    assert 3 <= told.index("next") <= 5
    time.sleep(0.3)
    assert len(told) == count
    assert threading.active_count() == before
