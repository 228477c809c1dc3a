"""One environment or suite has one stored name, and is found in every spelling that is about."""

import pytest

from navrep_data.errors import UnknownNameError
from navrep_data.evaluate import get_suite
from navrep_data.registration import ENVIRONMENTS, camel_case, plain
from navrep_data.sim import describe_environment, environment_name, gymnasium_id, make_config, numpy_seed

SPELLINGS = ["navrep-test", "navreptest", "NavRepTest-v0", "navrep_data:NavRepTest-v0", "NavRepTest", "navrep_test"]


@pytest.mark.parametrize("name", SPELLINGS)
def test_every_spelling_is_the_same_environment_and_the_same_suite(name):
    assert environment_name(name) == "navrep-test"
    assert make_config(name) == make_config("navrep-test")
    assert make_config(name, physics="original") == make_config("navrep-test", physics="original")
    assert describe_environment(name) == describe_environment("navrep-test")
    assert gymnasium_id(name) == "NavRepTest-v0"
    assert numpy_seed(name, 3) == 1003
    assert get_suite(name).name == "navreptest"


def test_every_environment_is_found_by_its_gymnasium_id_and_none_by_anothers():
    assert len({plain(name) for name in ENVIRONMENTS}) == len(ENVIRONMENTS)
    for name in ENVIRONMENTS:
        assert environment_name(f"{camel_case(name)}-v0") == name
    assert get_suite("NavRep-27").name == "navrep27"


@pytest.mark.parametrize("name", ["navrep-tset", "NavRepTest-v1", "", None, 3])
def test_what_is_none_is_refused(name):
    with pytest.raises(UnknownNameError, match="Unknown environment"):
        make_config(name)
    with pytest.raises(UnknownNameError, match="Unknown suite"):
        get_suite(name)
