"""Shell completion of ``rgbt``: commands, options, groups, keys and values.

``eval "$(rgbt --completion bash)"`` adds completion for ``rgbt`` only. (Hydra's own script changes
the completion of ``python``.)
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from rgbt.checks import InputError, check_choice
from rgbt.config.options import choices_of, types_of
from rgbt.config.plain_command import COMMANDS, CommandGroup, PlainCommand

# Bash cuts words at "=" and ":", and replaces only what follows the last of them.
BASH = r"""# add to ~/.bashrc:  eval "$(rgbt --completion bash)"
_rgbt() {
    local words=${COMP_LINE:0:COMP_POINT}
    local word=${words##* } cut= IFS=$'\n'
    [[ $word == *[=:]* ]] && cut=${word%"${word##*[=:]}"}
    COMPREPLY=($(rgbt --complete "$words" 2>/dev/null))
    COMPREPLY=("${COMPREPLY[@]#"$cut"}")
}
complete -o nospace -o default -F _rgbt rgbt
"""

ZSH = r"""#compdef rgbt
# add to ~/.zshrc:  eval "$(rgbt --completion zsh)"
_rgbt() {
    local -a candidates
    candidates=(${(f)"$(rgbt --complete "${(j: :)words[1,CURRENT]}" 2>/dev/null)"})
    (( ${#candidates} )) && compadd -S '' -a candidates || _files
}
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit }
compdef _rgbt rgbt
"""

FISH = """# type:  rgbt --completion fish > ~/.config/fish/completions/rgbt.fish
complete -c rgbt -a '(rgbt --complete (commandline -cp | string collect) 2>/dev/null)'
"""

SCRIPTS = {"bash": BASH, "zsh": ZSH, "fish": FISH}

OF_HYDRA = ("run", "check", "masks")
"""Commands whose arguments are all overrides."""

HYDRA_OPTIONS = ("-m", "--multirun", "--help", "--cfg", "--resolve")


def print_script(words: Sequence[str]) -> int:
    """Write the script of the shell that `words` name to stdout.

    Raises:
        InputError: none, or an unknown one.
    """
    if len(words) != 1:
        raise InputError(f"--completion needs the name of a shell: {', '.join(SCRIPTS)}.")
    check_choice("--completion", words[0], SCRIPTS)
    sys.stdout.write(SCRIPTS[words[0]])
    return 0


def print_candidates(words: Sequence[str]) -> int:
    """Print the `candidates` for the command line in `words`, one per line."""
    with suppress(Exception):  # errors must not appear while a shell completes
        sys.stdout.write("".join(f"{each}\n" for each in candidates(" ".join(words))))
    return 0


def candidates(line: str) -> list[str]:
    """Whole words that the last word of a line may become.

    Args:
        line: from ``rgbt`` up to the cursor; a space at its end begins a new word.
    """
    name, *words = [*line.split()[1:], *([""] if line.endswith(" ") else [])]
    if not words:
        return _begin(name, [*(f"{each} " for each in COMMANDS), "--help "])
    if name not in COMMANDS:
        return []
    if words[-1].startswith("-"):
        return _begin(words[-1], HYDRA_OPTIONS if name in OF_HYDRA else ("--help",))
    if name in OF_HYDRA:
        return _of_hydra(words)
    command = importlib.import_module(COMMANDS[name].module).entry
    if not isinstance(command, CommandGroup):
        return _of_options(command, words)
    first, *rest = words
    if rest and first in command.commands:
        return _of_options(command.commands[first], rest)
    named = [] if rest else _begin(first, [f"{each} " for each in command.commands])
    return [*named, *(_of_options(command.default, words) if command.default else [])]


def _of_options(command: PlainCommand[Any], words: Sequence[str]) -> list[str]:
    """Options, their values, and overrides of the configuration that take effect."""
    kinds = types_of(command.options)
    *others, last = words
    key, equals, _ = last.partition("=")
    if equals and key in kinds:
        return _begin(last, [f"{key}={each} " for each in choices_of(kinds[key])])
    given = [word.partition("=")[0] for word in others]
    options = _begin(last, [f"{name}=" for name in kinds if name not in given])
    heeds = command.heeds
    if heeds == () or (heeds is None and not last):  # all of them would hide the options
        return options
    overrides = [word for word, key in zip(others, given, strict=True) if key not in kinds]
    known = _of_hydra([*overrides, last])
    return [*options, *(each for each in known if each.startswith(tuple(heeds or ("",))))]


def _of_hydra(words: Sequence[str]) -> list[str]:
    """What Hydra knows: groups, their files, keys; also behind a comma."""
    from hydra.core.global_hydra import GlobalHydra
    from hydra.plugins.completion_plugin import DefaultCompletionPlugin

    from rgbt.config.compose import own_hydra

    *others, last = words
    typed, comma, value = last.rpartition(",")
    word = f"{typed.partition('=')[0]}={value}" if comma else last
    with own_hydra():
        plugin = DefaultCompletionPlugin(GlobalHydra.instance().config_loader())
        known = plugin._query("config", " ".join([*others, word]))
    if comma:
        return [f"{typed},{each.partition('=')[2]}" for each in known]
    # A group that holds a folder beside its files has no "=" in Hydra's answer.
    return [each if "=" in word or each[-1] in "=./" else f"{each}=" for each in known]


def _begin(word: str, known: Sequence[str]) -> list[str]:
    return [each for each in known if each.startswith(word)]
