"""The heap of a process that handles images: memory stays until it is trimmed."""

from __future__ import annotations

import mmap

from support.started import printed_by

PROGRAM = """
import resource
import threading
from pathlib import Path
from yolov5_lifecycle.process.memory import prepare_heap, trim_heap

IMAGE_BYTES, ROUNDS = 1280 * 720 * 3, 20

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

def resident_pages():
    return int(Path("/proc/self/statm").read_text().split()[1])

def copies_of_an_image():
    for _ in range(3):
        copies = [bytearray(b"x") * IMAGE_BYTES for _ in range(3)]

def as_a_thread_would():
    copies_of_an_image()
    before = faults()
    for _ in range(ROUNDS):
        copies_of_an_image()
    print(round((faults() - before) / ROUNDS))

prepare_heap()
thread = threading.Thread(target=as_a_thread_would)
thread.start()
thread.join()
before = resident_pages()
trim_heap()
print(before - resident_pages())
"""
PAGES_OF_AN_IMAGE = 1280 * 720 * 3 // mmap.PAGESIZE


def test_images_get_no_new_pages_and_trimming_releases_them() -> None:
    faults_of_a_round, given_back = map(int, printed_by(PROGRAM).split())
    assert faults_of_a_round < 0.1 * PAGES_OF_AN_IMAGE
    assert given_back > 2.5 * PAGES_OF_AN_IMAGE
