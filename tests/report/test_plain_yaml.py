import datetime

import pytest
import yaml

from src.report.plain_yaml import MAX_DEPTH, PlainYAMLError, check_plain_yaml, load_plain_yaml

BOMB = "a: &a [0,0,0,0,0,0,0,0,0]\n" + "".join(
    f"{y}: &{y} [{','.join(9 * [f'*{x}'])}]\n" for x, y in zip("abcdefghi", "bcdefghij", strict=True)
)


def test_plain_values_are_as_yaml_reads_them():
    text = "a: 1\nb: [1.5, null, true, 'x: &y', \"*z\"]\nc: {d: [], e: 2020-01-02}\nf: |\n  [[[[ &a *b\n"
    assert load_plain_yaml(text) == yaml.safe_load(text)
    assert load_plain_yaml(text)["c"]["e"] == datetime.date(2020, 1, 2)
    assert load_plain_yaml("") is None and load_plain_yaml("- &a 1") == [1]


@pytest.mark.parametrize(
    "text, words",
    [
        ("[" * 100_000, "more than 50 levels"),  # kills the fast reader's process
        ("{a: " * 100_000, "more than 50 levels"),
        ("".join(" " * level + "a:\n" for level in range(1000)), "more than 50 levels"),
        (BOMB, r"line 2: references \(\*a\)"),
        ("a: &a [*a]", "references"),
        ("<<: *x\n", "references"),
        ("a: {", "expected"),
        ("a: 1\nb: {c: 1}\na: 2", "line 3: a stands twice"),
        ("- {a: [{b: 1}, {b: 1, c: b, b: 2}]}", "b stands twice"),
        ("a: \0", "control characters"),
        ("a: !!python/object/apply:os.system ['true']", "python/object"),
        ("a: !!int ''", "IndexError"),
        ("a: !!timestamp x", "AttributeError"),
        ("a: !!bool x", "KeyError"),
        ("a: 2026-13-45", "month"),
        ("? [1]\n: 2", "unhashable"),
        ("a: " + "9" * 5000, "digits"),
        ("x" * 1_000_001, "at most 1000000 characters"),
        ("a: \ud800", "surrogates"),
    ],
)
def test_what_brings_a_reader_down_is_refused(text, words):
    with pytest.raises(PlainYAMLError, match=words) as caught:
        load_plain_yaml(text)
    assert isinstance(caught.value, ValueError) and isinstance(caught.value, yaml.YAMLError)
    assert "\n" not in str(caught.value)


def test_the_deepest_text_that_is_read():
    text = "[" * MAX_DEPTH + "]" * MAX_DEPTH
    check_plain_yaml(text)
    assert load_plain_yaml(text)
    with pytest.raises(PlainYAMLError):
        check_plain_yaml(f"[{text}]")
