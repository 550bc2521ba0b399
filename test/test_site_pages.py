"""The documentation site: every link of the repository is one of the site, which MkDocs checks."""

from __future__ import annotations

import re

import pytest
from support.colcon_workspace import REPOSITORY

from tools.site_pages import published, site_path, with_links_of_site

pytestmark = pytest.mark.long


def test_no_two_files_share_a_place_even_where_case_does_not_count() -> None:
    places = [site_path(path).lower() for path in published()]
    assert sorted(set(places)) == sorted(places)


@pytest.mark.parametrize(
    ("page", "text", "expected"),
    [
        pytest.param("README.md", "[a](docs/gpu.md)", "[a](gpu.md)", id="from README to a page"),
        pytest.param("docs/gpu.md", "[a](../README.md)", "[a](index.md)", id="back"),
        pytest.param("docs/gpu.md", "[a](images.md#encodings)", "[a](images.md#encodings)", id="heading"),
        pytest.param("README.md", "[a](SECURITY.md)", "[a](project/security.md)", id="page beside README"),
        pytest.param("SECURITY.md", "[a](docs/security.md)", "[a](../security.md)", id="from such a page"),
        pytest.param("README.md", "[a](https://example.org/a.md)", "[a](https://example.org/a.md)", id="web"),
        pytest.param("README.md", "[a](docs/no.md)", "[a](docs/no.md)", id="dead: left for MkDocs to refuse"),
        pytest.param("README.md", "", "", id="empty"),
    ],
)
def test_a_link_of_the_repository_becomes_one_of_the_site(page: str, text: str, expected: str) -> None:
    assert with_links_of_site(text, page) == expected


def test_a_dead_link_is_an_error_and_no_page_loads_anything_from_another_host() -> None:
    configuration = (REPOSITORY / "mkdocs.yml").read_text()
    assert "\nstrict: true\n" in configuration
    validation = configuration.partition("\nvalidation:\n")[2].partition("\n\n")[0]
    assert set(re.findall(r": (\w+)", validation)) == {"warn"}  # which `strict` makes errors
    assert "\n  font: false" in configuration
