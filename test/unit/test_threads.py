"""One limit for all threads that compute."""

from __future__ import annotations

import json
import os
import subprocess
import sys

# As in the node: numpy, OpenCV and numba are there before the limit is known, torch and faiss come later, and work is
# done in a thread of its own.
LIMITED = """
import json, threading
import cv2, numba, numpy, scipy.linalg
from gsfeatloc_ros.common.threads import limit_threads
limit_threads(1)
import faiss, torch
from threadpoolctl import threadpool_info
found = {}
def look():
    found.update({pool["filepath"]: pool["num_threads"] for pool in threadpool_info()})
    found.update(cv2=cv2.getNumThreads(), numba=numba.config.NUMBA_NUM_THREADS, torch=torch.get_num_threads())
    found.update(faiss=faiss.omp_get_max_threads())
thread = threading.Thread(target=look)
thread.start()
thread.join()
print(json.dumps(found))
"""


def test_the_limit_holds_for_all_libraries():
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", LIMITED], capture_output=True, text=True, timeout=240, check=True, env=environment
    )
    found = json.loads(done.stdout)
    assert {"cv2", "numba", "torch", "faiss"} < set(found)
    assert any("openblas" in name for name in found)
    assert set(found.values()) == {1}, found
