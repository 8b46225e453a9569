"""Ctrl-C while compiled code runs in the main thread."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

# A shell starts what it runs in the background with interrupts ignored.
HEARD = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
"""
LONG_WORK = """
import hashlib, sys
from walop_jax.io.progress import interrupts_answered

def end():
    print("interrupted", file=sys.stderr, flush=True)
    return 130

with interrupts_answered(end):
    print("at work", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"one call", b"without an instruction of Python", 100_000_000)
"""
QUICK_WORK = """
import time
from walop_jax.io.progress import interrupts_answered

for _ in range(2):
    try:
        with interrupts_answered(lambda: 99):
            print("at work", flush=True)
            time.sleep(60)
    except KeyboardInterrupt:
        print("answered", flush=True)
"""


def started(text):
    process = subprocess.Popen(
        [sys.executable, "-c", HEARD + text], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "at work\n"
    return process


def test_an_interrupt_ends_a_call_that_does_not_come_back():
    with started(LONG_WORK) as process:
        time.sleep(0.5)  # until it is in the call
        began = time.monotonic()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 130
    assert errors == "interrupted\n"
    assert time.monotonic() - began < 5.0  # 1.5 s on a machine that is not busy


def test_an_interrupt_that_is_answered_is_left_to_who_answers():
    with started(QUICK_WORK) as process:
        for line in ("answered\n", "at work\n", "answered\n"):
            if line == "answered\n":
                time.sleep(0.3)  # until it sleeps
                process.send_signal(signal.SIGINT)
            assert process.stdout.readline() == line
        assert process.wait(timeout=30) == 0
