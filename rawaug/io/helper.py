"""A process that decodes for this one, as seen from here: what it is asked, its answers, and how it ends.

:mod:`rawaug.io.reading_process` is its own side.
"""

from __future__ import annotations

import math
import os
import pickle
import select
import signal
import socket
import weakref
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import cycle
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from rawaug.io.reading_process import MEMORIES
from rawaug.io.shared_arrays import SharedMemory, unpickled

LIMIT = "RAWAUG_READ_SECONDS"
PATIENCE = 10
"""Times the limit that a file may take where the helper has not used the limit of a processor: on a busy machine."""
START_SECONDS = 300.0
"""For the first helper, which waits until the libraries are imported."""
MESSAGE_SECONDS, MOST = 16e-3, 16
"""What a message of several calls should take, and how many it has at most."""


class Lost(Exception):
    """The helper died or hung; the text says which."""


class Helper:
    """A helper process: a connection, the memories that it shares, and what it has been asked.

    Attributes:
        waited: for the answers to come, in order: the number of the memory, and the calls sent for it.
        expected: calls that it has been sent and has not answered.
        few: calls that are worth a message, by the time that the last ones took.
        busy: the processor's seconds at its last answer.
    """

    def __init__(self, link: socket.socket) -> None:
        link.settimeout(START_SECONDS)
        try:
            message, descriptors, *_ = socket.recv_fds(link, 64, MEMORIES)
            self.pid = int(message)
        except (OSError, ValueError):
            link.close()
            raise RuntimeError("the process that helpers come from did not start") from None
        link.settimeout(None)
        self.memories = [SharedMemory(descriptor) for descriptor in descriptors]
        self.owner, self.busy, self.expected, self.few = os.getpid(), 0.0, 0, 1
        self.waited, self.turns = deque[tuple[int, int]](), cycle(range(MEMORIES))
        self.connection = Connection(link.detach())
        self.answered = select.poll()
        self.answered.register(self.connection.fileno(), select.POLLIN)
        self.let_go = weakref.finalize(self, _close, self.connection, descriptors)

    @property
    def idle(self) -> bool:
        """Whether it is there, for this process, and has answered all."""
        return not (self.waited or self.expected or self.owner != os.getpid() or self.answered.poll(0))

    @property
    def next(self) -> int:
        """Calls, at most, that the next answer is for."""
        return self.late + (self.waited[0][1] if self.waited else 0)

    @property
    def late(self) -> int:
        """Calls that did not fit into the answer that they were sent for."""
        return self.expected - sum(calls for _, calls in self.waited)

    def ask(self, read: Callable[..., Any], calls: Sequence[Any]) -> None:
        """Send calls, and let it fill the memory whose turn it is with answers to these or earlier ones."""
        which = next(self.turns)
        self.waited.append((which, len(calls)))
        self.expected += len(calls)
        with suppress(ConnectionError):  # it has died, which the answer says
            self.connection.send_bytes(pickle.dumps((which, _folder(), read, calls)))

    def answer(self, seconds: float) -> list[tuple[bool, Any]]:
        """Of each of the next calls, at least of one, whether there is a value, and the value or the error.

        Raises:
            Lost: if the helper dies or takes longer.
        """
        try:
            if not self._answers(seconds):
                self.kill()
                raise Lost(f"cannot be read within {seconds:g} s ({LIMIT}); leave it out, or copy it again")
            busy, answers, kinds = pickle.loads(self.connection.recv_bytes())
        except (EOFError, ConnectionError):
            busy, answers, kinds = None, 0, []
        if busy is None:
            self.let_go()
            raise Lost(f"crashes the decoder ({_ending(answers)}); leave it out, or copy it again")
        arrays = self.memories[self.waited.popleft()[0]].copies(kinds)
        if answers:
            pace = max(1e-9, busy - self.busy) / len(answers)
            self.few = min(max(1, round(MESSAGE_SECONDS / pace)), MOST)
        self.busy, self.expected = busy, self.expected - len(answers)
        return [unpickled(answer, arrays) for answer in answers]

    def drain(self, seconds: float) -> None:
        """Take the answers that are left when all calls have been answered, as there was room for more in others."""
        with suppress(Lost):  # which is no file's fault
            while self.waited:
                self.answer(seconds)

    def _answers(self, seconds: float) -> bool:
        """Whether an answer comes; a helper that other programs keep from running gets more time."""
        for _ in range(PATIENCE):
            if self.answered.poll(1e3 * seconds):
                return True
            if not _processor_seconds(self.pid) < self.busy + seconds:
                return False
        return False

    def kill(self) -> None:
        """End the process, whatever it does."""
        with suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)
        self.let_go()


def _folder() -> str | None:
    """The working folder, in which the helper finds a relative path; None if it has been removed."""
    try:
        return str(Path.cwd())
    except FileNotFoundError:
        return None


def _processor_seconds(process: int) -> float:
    """What a process has used of the processors; infinite where the system does not say."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError):
        return math.inf


def _close(connection: Connection, memories: Sequence[int]) -> None:
    """Let go of a helper, which then ends, or is killed if it is at work."""
    connection.close()
    for descriptor in memories:
        os.close(descriptor)


def _ending(status: int) -> str:
    if os.WIFSIGNALED(status):
        return f"killed by {signal.Signals(os.WTERMSIG(status)).name}"
    return f"exited with status {os.waitstatus_to_exitcode(status)}"
