"""Runs in kiss-slam's own environment, started by slam_peers.py; knows nothing of lslam.

Reads pairs of arrays (points (N, 3), m, and times (N,), 0 to 1 of the sweep) from stdin until it ends; writes the poses
(N, 4, 4) and the seconds of the process and of the wall that all of kiss-slam took to stdout.
"""

from __future__ import annotations

import ctypes
import io
import os
import sys
import time

import libusb_package
import numpy as np


def main() -> None:
    # What kiss-slam prints must not get among the arrays.
    stream, sys.stdout = os.fdopen(os.dup(1), "wb"), sys.stderr
    os.dup2(2, 1)
    # kiss-slam imports Open3D, whose wheel leaves libusb to the system.
    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    from kiss_slam.config import load_config
    from kiss_slam.slam import KissSLAM

    config = load_config(None)
    config.odometry.preprocessing.deskew = sys.argv[1] == "deskew"
    slam = KissSLAM(config)
    cpu = wall = 0.0

    def timed(call, *given):  # type: ignore[no-untyped-def]
        nonlocal cpu, wall
        began, began_wall = time.process_time(), time.perf_counter()
        found = call(*given)
        cpu, wall = cpu + time.process_time() - began, wall + time.perf_counter() - began_wall
        return found

    while size := sys.stdin.buffer.read(8):
        pair = np.load(io.BytesIO(sys.stdin.buffer.read(int.from_bytes(size, "little"))))
        timed(slam.process_scan, pair["points"].astype(np.float64), pair["times"].astype(np.float64))
    timed(slam.generate_new_node)
    slam.local_map_graph.erase_last_local_map()
    poses, _ = timed(slam.fine_grained_optimization)
    np.savez(stream, poses=np.array(poses), seconds=np.array([cpu, wall]), closures=len(slam.closures))


if __name__ == "__main__":
    main()
