"""Sections of the report that installed packages add: the one of docs/extend.md."""

from __future__ import annotations

import pytest

from tests.commands import done
from tests.test_extensions import add, one_line, site  # noqa: F401  # a fixture


@pytest.mark.usefixtures("site")
def test_a_section_of_a_package_stands_in_the_page_and_its_data_in_the_json(finished, tmp_path):
    said = done("report", finished, "-o", tmp_path / "a.html", "--json").out
    page = (tmp_path / "a.html").read_text()
    assert page.count("Frames with tracks.") == 1
    assert 'href="#lengths-0">Lengths</a>' in page
    assert '"lengths"' not in said  # it has no data


def test_a_section_that_fails_is_one_line(site, finished, tmp_path):  # noqa: F811
    add(site, "report_section", "odd", "def Part(*_):\n    return 1 / 0\n")
    said = one_line("report", str(finished), "-o", str(tmp_path / "a.html"))
    assert "report section odd (another 2.0) failed: ZeroDivisionError: division by zero (another.py, line 2)" in said
    assert not (tmp_path / "a.html").exists()
