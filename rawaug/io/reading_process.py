"""The process that helpers of :mod:`rawaug.io.apart` are forked from, and what a helper does.

It imports the libraries, decodes nothing itself and has no threads, so that a fork of it is as good as a new process.
To every connection it forks a helper, whose end it reports; it ends with the process that started it.
"""

from __future__ import annotations

import gc
import os
import pickle
import select
import shutil
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch

from rawaug.io.shared_arrays import SharedMemory, pickled

_LIBRARIES = ("h5py", "OpenImageIO", "PIL.Image", "PIL.ImageCms", "rawpy", "scipy.io", "tifffile")
FULL = 2**24
"""Bytes of values, of pixels above all, beyond which an answer takes no more calls."""
MEMORIES = 2
"""That a helper shares with the process that it helps: one is written while the other is read."""
_Call = tuple["str | None", Callable[..., Any], tuple[Any, ...]]
_CLOSED = select.POLLHUP | select.POLLERR | getattr(select, "POLLRDHUP", 0)


def serve() -> None:
    """The process: its arguments are the socket's number, the folder of its address, and modules to import first."""
    number, folder, *modules = sys.argv[2:]
    for name in (*_LIBRARIES, *modules):
        with suppress(ImportError):
            import_module(name)
    torch.set_num_threads(1)
    gc.freeze()
    try:
        with socket.socket(fileno=int(number)) as listening:
            _serve(listening)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _serve(listening: socket.socket) -> None:
    """Fork, report and reap until standard input ends."""
    woken, waking = os.pipe()
    os.set_blocking(waking, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(waking)
    links: dict[int, tuple[int, socket.socket]] = {}  # by descriptor: the helper and the connection
    poll = select.poll()
    for descriptor, events in ((0, _CLOSED), (listening.fileno(), select.POLLIN), (woken, select.POLLIN)):
        poll.register(descriptor, events)
    while True:
        for descriptor, events in poll.poll():
            if descriptor == 0:
                return
            if descriptor == listening.fileno():
                link, _ = listening.accept()
                helper = os.fork()
                if not helper:
                    _help([listening, *(other for _, other in links.values())], link, (woken, waking))
                links[link.fileno()] = helper, link
                poll.register(link.fileno(), _CLOSED)
            elif descriptor == woken:
                os.read(woken, 4096)
                for found in list(_ended(links)):
                    poll.unregister(found)
                    links.pop(found)[1].close()
            elif descriptor in links and events & _CLOSED:  # nobody waits for what it does
                poll.modify(descriptor, 0)
                os.kill(links[descriptor][0], signal.SIGKILL)


def _ended(links: dict[int, tuple[int, socket.socket]]) -> Iterator[int]:
    """The connections of helpers that have ended, which is reported."""
    by_helper = {helper: descriptor for descriptor, (helper, _) in links.items()}
    with suppress(ChildProcessError):
        while True:
            helper, status = os.waitpid(-1, os.WNOHANG)
            if not helper:
                return
            with suppress(OSError):
                _send(links[by_helper[helper]][1].fileno(), (None, status, ()))
            yield by_helper[helper]


def _send(descriptor: int, answer: Any) -> None:
    with Connection(os.dup(descriptor)) as connection:
        connection.send_bytes(pickle.dumps(answer))


# -- a helper ---------------------------------------------------------------------------------------------------------


def _help(others: list[socket.socket], link: socket.socket, pipe: tuple[int, int]) -> None:
    """Answer one connection until it closes; never returns."""
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    for descriptor in (0, *pipe):
        os.close(descriptor)
    for other in others:
        other.close()
    status = 1
    try:
        memories = [SharedMemory() for _ in range(MEMORIES)]
        socket.send_fds(link, [str(os.getpid()).encode()], [memory.file for memory in memories])
        with Connection(link.detach()) as connection, suppress(EOFError, ConnectionError):
            todo = deque[_Call]()
            while True:
                _answer(connection, memories, todo)
        status = 0
    finally:
        os._exit(status)


def _answer(connection: Connection, memories: list[SharedMemory], todo: deque[_Call]) -> None:
    """The processor's seconds so far, and what came of the first calls: of one, or as many as FULL holds."""
    which, folder, read, calls = pickle.loads(connection.recv_bytes())
    todo.extend((folder, read, arguments) for arguments in calls)
    answers, arrays = list[bytes](), list[np.ndarray]()
    while todo and sum(array.nbytes for array in arrays) < FULL:
        answer = _attempt(*todo.popleft())
        try:
            answers.append(pickled(answer, arrays))
        except (pickle.PicklingError, TypeError, AttributeError):  # an exception of an extension
            _, value = answer
            answers.append(pickle.dumps((False, RuntimeError(f"{type(value).__name__}: {value}"))))
    kinds = memories[which].put(arrays)
    connection.send_bytes(pickle.dumps((time.process_time(), answers, kinds)))


def _attempt(folder: str | None, read: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[bool, Any]:
    """Whether there is a value, and the value or the error."""
    try:
        if folder is not None:
            os.chdir(folder)
        return True, read(*arguments)
    except Exception as error:
        return False, error
