"""Scripts by which a shell completes ``rgbt``: ``eval "$(rgbt --completion bash)"``.

They complete the command ``rgbt`` alone. (Hydra's own script takes over ``python``.)
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rgbt.checks import InputError, check_choice

# Bash cuts words at "=" and ":", and replaces only what follows the last of them.
BASH = r"""_rgbt() {
    local words=${COMP_LINE:0:COMP_POINT}
    local word=${words##* } cut= IFS=$'\n'
    [[ $word == *[=:]* ]] && cut=${word%"${word##*[=:]}"}
    COMPREPLY=($(rgbt --complete "$words" 2>/dev/null))
    COMPREPLY=("${COMPREPLY[@]#"$cut"}")
}
complete -o nospace -o default -F _rgbt rgbt
"""

ZSH = r"""#compdef rgbt
_rgbt() {
    local -a candidates
    candidates=(${(f)"$(rgbt --complete "${(j: :)words[1,CURRENT]}" 2>/dev/null)"})
    (( ${#candidates} )) && compadd -S '' -a candidates || _files
}
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit }
compdef _rgbt rgbt
"""

FISH = """complete -c rgbt -a '(rgbt --complete (commandline -cp | string collect) 2>/dev/null)'
"""

SCRIPTS = {"bash": BASH, "zsh": ZSH, "fish": FISH}

INSTALL = {
    "bash": 'add to ~/.bashrc:  eval "$(rgbt --completion bash)"',
    "zsh": 'add to ~/.zshrc:  eval "$(rgbt --completion zsh)"',
    "fish": "type:  rgbt --completion fish > ~/.config/fish/completions/rgbt.fish",
}


def print_script(words: Sequence[str]) -> int:
    """Write the script of a shell to stdout.

    Args:
        words: the name of the shell.

    Raises:
        InputError: none, or an unknown one.
    """
    if len(words) != 1:
        raise InputError(f"--completion needs the name of a shell: {', '.join(SCRIPTS)}.")
    check_choice("--completion", words[0], SCRIPTS)
    sys.stdout.write(f"# {INSTALL[words[0]]}\n{SCRIPTS[words[0]]}")
    return 0
