"""The documentation site: every link of the repository is one of the site, which MkDocs checks."""

from __future__ import annotations

import pytest

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
        pytest.param("README.md", "[a](SECURITY.md)", "[a](project/security.md)", id="page beside README"),
        pytest.param("SECURITY.md", "[a](docs/security.md)", "[a](../security.md)", id="from such a page"),
        pytest.param("README.md", "[a](docs/no.md)", "[a](docs/no.md)", id="dead: left for MkDocs to refuse"),
    ],
)
def test_a_link_of_the_repository_becomes_one_of_the_site(page: str, text: str, expected: str) -> None:
    assert with_links_of_site(text, page) == expected
