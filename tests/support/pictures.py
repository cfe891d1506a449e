"""Pictures that do not behave, in place of `hil.live.picture`; what they do is their whole program."""

import sys

STALLS = "print('ready', flush=True); import signal; signal.pause()"
IS_CLOSED = """
import pyarrow as pa, sys
print('ready', flush=True)
reader = pa.ipc.open_stream(sys.stdin.buffer)
print('taken', reader.read_next_batch().num_rows, flush=True)
"""  # in mid-flight
NEVER_COMES_UP = "import signal; signal.pause()"
FAILS = "print('failed no such screen', flush=True)"
DIES = "raise SystemExit"
TAKES_ALL = """
import pyarrow as pa, sys
print('ready here', flush=True)
reader, taken = pa.ipc.open_stream(sys.stdin.buffer), 0
for batch in reader:
    taken += batch.num_rows
    print('taken', taken, flush=True)
print('typed set a.b 2.0', flush=True)
"""


def picture(program: str) -> list[str]:
    """The command of a picture."""
    return [sys.executable, "-c", program]
