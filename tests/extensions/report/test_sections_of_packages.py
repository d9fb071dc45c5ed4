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


@pytest.mark.parametrize(
    ("section", "why"),
    [
        ("1 / 0", "failed: ZeroDivisionError: division by zero (another.py, line 3)"),
        ("'html'", "gave a str; its function has to give a ReportSection"),
        ("ReportSection('a', None)", "gave what is no ReportSection: TypeError: None is no text"),
        ("ReportSection('a', 'b', [('c',)])", "gave what is no ReportSection: ValueError"),
        (
            "ReportSection('a', 'b', [('c', ['d'], [('e', [('tracks', 'f', '/g', [1])])])])",
            "gave what is no ReportSect",
        ),
        ("ReportSection('a', 'b', figures=[3])", "gave what is no ReportSection: TypeError"),
        ("ReportSection('a', 'b', data=object())", "gave what is no ReportSection: TypeError"),
    ],
)
def test_a_section_that_fails_or_is_none_is_one_line(site, finished, tmp_path, section, why):  # noqa: F811
    code = f"from mcaptrack.contracts import ReportSection\ndef Part(*_):\n    return {section}\n"
    add(site, "report_section", "odd", code)
    said = one_line("report", str(finished), "-o", str(tmp_path / "a.html"))
    assert f"report section odd (another 2.0) {why}" in said
    assert not (tmp_path / "a.html").exists()
