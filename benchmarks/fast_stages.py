"""The stages up to annotate for the scale benchmark: everything is real but pixels and start-up.

Plan, poses, cameras, rows, hashes, files, locks, resuming, publishing and labels are the stages'
own; only the three pictures of a view are the same three small ones everywhere. And because
importing PyTorch 600 times would be most of the work, one server imports it and forks a process for
each call of `ntop`; `fast_client.py` is the `ntop` that the rules find on PATH.

Usage: python benchmarks/fast_stages.py SOCKET
"""

import hashlib
import json
import os
import select
import signal
import socket
import sys
import traceback
from functools import lru_cache
from pathlib import Path

import numpy as np

from ntop import cli
from ntop.stages import s5_render
from ntop.storage.atomic import write_bytes
from ntop.storage.images import encode_depth, encode_parts, encode_rgba

SIZE_PX = 64
DEPTH_M = 1.5
MESSAGE_BYTES = 1 << 20


@lru_cache(maxsize=1)
def ready_pictures() -> dict[str, bytes]:
    """The encoded pictures of a body that fills the middle of the view."""
    v, u = np.mgrid[:SIZE_PX, :SIZE_PX] + 0.5
    inside = np.hypot(u - SIZE_PX / 2, v - SIZE_PX / 2) < 0.4 * SIZE_PX
    rgb = np.stack([u, v, u], -1) / SIZE_PX
    return {
        "image_path": encode_rgba(rgb, inside.astype(float)),
        "depth_path": encode_depth(DEPTH_M * inside.astype(np.float32)),
        "parts_path": encode_parts(inside.astype(np.uint8)),
    }


def write_ready_view(_rendering: None, paths: dict[str, Path]) -> str:
    """Write a view's three files as the stage does; returns the image's SHA-256."""
    for column, content in ready_pictures().items():
        write_bytes(paths[column], content)
    return hashlib.sha256(ready_pictures()["image_path"]).hexdigest()


def serve(path: str) -> None:
    """Fork a process for every call that comes, until SIGTERM."""
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(path)
        server.listen(64)
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
        while True:
            if select.select([server], [], [], 1.0)[0]:
                connection, _ = server.accept()
                with connection:
                    message, handles, _, _ = socket.recv_fds(connection, MESSAGE_BYTES, 2)
                    if os.fork() == 0:
                        server.close()
                        call(connection, json.loads(message), handles)
                    for handle in handles:
                        os.close(handle)
            reap()


def call(connection: socket.socket, message: dict, handles: list[int]) -> None:
    """Be `ntop` for one caller; never returns."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    code = 1
    try:
        os.dup2(handles[0], 1)
        os.dup2(handles[1], 2)
        os.chdir(message["folder"])
        code = cli.main(message["words"])
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException:  # whatever it was, the caller must hear that it failed
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        connection.sendall(bytes([code]))
        os._exit(code)


def reap() -> None:
    """Bury the processes that have ended: their times then count as the server's."""
    try:
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
    except ChildProcessError:
        return


if __name__ == "__main__":
    s5_render.pose_avatar = lambda *_, **__: None
    s5_render.render_view = lambda *_, **__: None
    s5_render.write_view = write_ready_view
    serve(sys.argv[1])
