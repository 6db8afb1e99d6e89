"""`ntop` as the rules of the scale benchmark find it: hands its words to `fast_stages.py`.

Usage: python -ISs benchmarks/fast_client.py SOCKET WORDS...
"""

import json
import socket
import sys
from pathlib import Path

_, path, *words = sys.argv
if words[0] == "lease":  # of no GPU: what follows `--` is `ntop` again
    words = words[words.index("--") + 2 :]
with socket.socket(socket.AF_UNIX) as connection:
    connection.connect(path)
    message = json.dumps({"folder": str(Path.cwd()), "words": words}).encode()
    socket.send_fds(connection, [message], [1, 2])
    answer = connection.recv(1)
sys.exit(answer[0] if answer else 1)
