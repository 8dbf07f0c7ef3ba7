"""The package as a module of Python's command line."""

import subprocess
import sys


def test_the_package_is_a_command_where_its_script_is_not_on_the_path():
    help_text = subprocess.run(
        [sys.executable, "-m", "pointslam", "--help"], capture_output=True, text=True, check=True
    ).stdout

    assert help_text.startswith("usage: pointslam")
