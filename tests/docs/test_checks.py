"""The checks of the documentation find what is wrong with a page."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.docs.blocks import Page, PageError
from tests.docs.check_page import problems_of
from tests.docs.printed import difference

pytestmark = pytest.mark.docs


def page(text: str, folder: Path | None = None) -> Page:
    """A page as the test writes it; ~~~ stands for the three backticks."""
    text = "# A page\n\n" + text.replace("~~~", "```")
    path = (folder or Path("/nowhere")) / "page.md"
    if folder:
        path.write_text(text)
    return Page("page.md", text, path)


def bash(*lines: str) -> str:
    return "\n".join(["~~~bash", *lines, "~~~", ""])


GOOD = """\
Train, then look at `rgbt/run.py` and at [the top](#a-page).

~~~bash
# a comment, and a command on two lines
rgbt run +experiment=grbm +debug=smoke \\
    seed=1
rgbt run -m +experiment=grbm masker.sigma_div=1,2 hydra.sweeper.workers=2
rgbt evaluate run=runs/<key> regions=ring9
rgbt weights inspect runs/<key>/best.pt
rgbt reproduce table=spatialseg/table3 seeds=2 dry_run=true
ls runs | head -3
~~~

~~~text
any output
~~~

<!-- needs: MFNet -->
~~~bash
rgbt run +experiment=grbm dataset=mfnet dataset.root=/data/MFNet
~~~

~~~yaml title="conf/loss/mine.yaml"
_target_: rgbt.losses.cross_entropy.CrossEntropy
~~~

~~~bash
rgbt run loss=mine +debug=smoke
~~~

~~~python
print("a")
~~~
"""


def test_good_page_has_no_problem(tmp_path: Path) -> None:
    assert problems_of(page(GOOD), tmp_path) == []


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (bash("rgbt evalute run=runs/<key>"), "page.md:4: 'evalute' is not a command; did you"),
        (
            bash("rgbt evaluate rn=runs/<key>"),
            "page.md:4: 'rn' is not an option of this command; did",
        ),
        (bash("rgbt evaluate run=runs/<key> split"), "page.md:4: 'split': expected key=value"),
        (bash("# why", "rgbt run +experiment=grm"), "page.md:5: there is no experiment 'grm'; did"),
        (bash("rgbt run masker.sgma_div=2"), "page.md:4: 'masker.sgma_div' is not a key"),
        (bash("rgbt run trainer.max_steps=many"), "page.md:4: 'trainer.max_steps': "),
        (bash("rgbt run -m hydra.sweeper.wrkers=2 seed=0,1"), "page.md:4: 'hydra.sweeper.wrkers'"),
        (bash("rgbt run --experiment=grbm"), "page.md:4: '--experiment=grbm' is not an option"),
        (bash("rgbt reproduce table=crm/table9"), "page.md:4: there is no table 'crm/table9'"),
        (bash("rgbt weights inspct x.pt"), "page.md:4: expected a command, got 'inspct'"),
        (bash("rgbt spatial masker=crm"), "page.md:4: 'masker' has no effect here"),
        (bash("trgbt run"), "page.md:4: 'trgbt' is not a command that pages may use"),
        (bash("make dmo"), "page.md:4: make has no target 'dmo'"),
        (bash("rgbt run 'seed=1"), "page.md:4: the shell cannot read this line"),
        (bash("rgbt run \\"), "page.md:4: the last line of the block ends with a backslash"),
        (bash("rgbt check dataset=mfnet dataset.root=/data/MFNet"), "page.md:4: the data of /data"),
        (bash("rgbt predict run=runs/<key> input=<folder> out=x"), "page.md:4: a word in <>"),
        (bash("sbatch job.sh"), "page.md:4: 'sbatch' cannot run in a test"),
        (bash("echo " + 95 * "x"), "page.md:4: 100 characters of code; expected fewer than 100"),
        ("~~~\nrgbt run\n~~~\n", "page.md:3: a block with no language; expected bash"),
        ("~~~shell\nrgbt run\n~~~\n", "page.md:3: a block with language 'shell'; expected bash"),
        ("~~~python\nx = 1\nprint(\n~~~\n", "page.md:5: Python cannot read this: '(' was never"),
        ("~~~yaml\na: 1\nb: [1\n~~~\n", "page.md:6: YAML cannot read this: "),
        ('~~~yaml title="/etc/x.yaml"\na: 1\n~~~\n', "page.md:3: title=/etc/x.yaml: expected a"),
        (122 * "y " + "\n", "page.md:3: 244 characters; expected at most 120"),
        ("!!! note\n", "page.md:3: Git hosts do not show admonitions"),
        ("# Another\n", "page.md: 2 headings of level one; expected one"),
        ("See `rgbt/runs.py`.\n", "page.md:3: `rgbt/runs.py` is not a file of this repository"),
        ("See [this](gone.md).\n", "page.md:3: the link gone.md leads to no file"),
        ("See [this](#gone).\n", "page.md:3: the link #gone leads to no heading"),
    ],
)
def test_problem_is_named_with_its_line(text: str, problem: str, tmp_path: Path) -> None:
    folder = tmp_path / "reader"
    folder.mkdir()
    (found,) = problems_of(page(text, tmp_path), folder)
    assert found.startswith(problem), found


def test_mark_is_for_the_block_that_follows_it(tmp_path: Path) -> None:
    line = bash("rgbt check dataset=mfnet dataset.root=/data/MFNet")
    (problem,) = problems_of(page(f"<!-- needs: MFNet -->\n{line}\n{line}"), tmp_path)
    assert problem.startswith("page.md:9: the data of /data/")


def test_mistake_that_the_page_shows_is_no_problem(tmp_path: Path) -> None:
    shown = (
        bash("rgbt run +experiment=grm") + "\n~~~text\nrgbt: there is no experiment 'grm'\n~~~\n"
    )
    assert problems_of(page(shown), tmp_path) == []


FOLLOWED = """\
~~~python title="my_part.py"
def answer():
    return 41
~~~

~~~python title="my_part.py"


def more():
    return answer() + 1
~~~

~~~bash
export GREETING=$PWD/hello
mkdir out
echo "$GREETING" > out/greeting.txt
rgbt masks +experiment=grbm +debug=smoke out=out/sheet.png
~~~

~~~python
from pathlib import Path

import my_part

written = Path("out/greeting.txt").read_text()
assert written.strip() == str(Path.cwd() / "hello")
assert Path("out/sheet.png").is_file()
~~~

<!-- needs: GPU -->
~~~python
raise RuntimeError("not run")
~~~

~~~python
assert my_part.more() == 42
assert written
~~~

~~~bash
rgbt masks +experiment=nowhere
~~~

~~~text
rgbt: there is no experiment 'nowhere'
~~~
"""


def test_page_is_followed_in_order(follow: Callable[..., int]) -> None:
    assert follow(page(FOLLOWED)) == 6


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (bash("rgbt masks +experiment=nowhere"), "page.md:4: rgbt masks +experiment=nowhere"),
        (bash("cat nothing.txt"), "page.md:4: exit code 1: cat: nothing.txt"),
        ("~~~python\nassert 1 == 2\n~~~\n", "page.md:3: Traceback"),
        (
            "~~~python\nprint('mIoU', 2.5)\n~~~\n~~~text\nmIoU 3.5\n~~~\n",
            "page.md:3: the page shows '3.5' as word 2, the block prints '2.5'",
        ),
        (bash("for n in 1 2; do rgbt run seed=$n; done"), "page.md:3: a training in a loop"),
        (
            bash("rgbt masks +experiment=nowhere") + "\n~~~text\nrgbt: another mistake\n~~~\n",
            "page.md:4: rgbt masks +experiment=nowhere: exit code 2, expected the sentence 'a",
        ),
    ],
)
def test_failure_of_a_followed_page_is_named_with_its_line(
    text: str, problem: str, follow: Callable[..., int]
) -> None:
    with pytest.raises(PageError) as caught:
        follow(page(text))
    assert str(caught.value).startswith(problem), caught.value


@pytest.mark.slow
def test_newest_run_stands_for_the_key(follow: Callable[..., int]) -> None:
    text = bash(
        "rgbt evaluate run=runs/<key>",
        "rgbt run +experiment=grbm masker.sigma_div=3 trainer.max_steps=40000",
        "grep -q 'sigma_div: 3' runs/<key>/config.yaml",
        "rgbt compare a=grbm b='grbm masker.sigma_div=3'",
    )
    assert follow(page(text)) == 4


@pytest.mark.parametrize(
    ("shown", "printed", "is_equal"),
    [
        ("mIoU 61.30\n58.99 to 63.18", "mIoU 61.31 58.99\nto 63.18", True),
        ("mIoU 61.30", "mIoU 63.30", False),
        ("a b", "a c", False),
        ("a", "a b", False),
        ("a\n...", "a b", True),
        ("a b", "a", False),
        ("(0.333, 12)", "(0.3333, 12)", True),
    ],
)
def test_printed_words_are_compared(shown: str, printed: str, is_equal: bool) -> None:
    assert (difference(shown, printed) == "") is is_equal
