"""The thread that tidies up goes on when a disk refuses."""

import threading

import pytest

from services.mapping.storage.janitor import Janitor
from shared.errors import StorageError


@pytest.mark.parametrize("fault", [StorageError("disk full"), PermissionError("no entry")])
def test_a_task_that_fails_is_done_again(fault):
    runs, is_enough = [], threading.Event()

    def task() -> None:
        runs.append(1)
        if len(runs) == 3:
            is_enough.set()
        raise fault

    janitor = Janitor(0.001, [task])
    janitor.start()

    assert is_enough.wait(60.0)
    janitor.stop()
