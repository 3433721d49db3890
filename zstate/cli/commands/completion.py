"""zstate completion: completion scripts for bash, zsh and fish."""

from __future__ import annotations

import click

from zstate.cli.output.console import print_result

# Corrections of click's scripts: zsh without completion has no compdef yet; in fish, everything after the
# first comma of a help text would be lost.
_CORRECTIONS = {
    "zsh": (
        "#compdef zstate\n",
        "#compdef zstate\n\n(( $+functions[compdef] )) || { autoload -Uz compinit && compinit -i }\n",
    ),
    "fish": ('string split "," $completion', 'string split --max 1 "," $completion'),
}


@click.command("completion")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion_command(shell: str) -> None:
    """Print the script with which SHELL completes commands, options, models, files and announced robots.

    \b
    eval "$(zstate completion bash)"                   # now; in ~/.bashrc for good
    eval "$(zstate completion zsh)"                    # in ~/.zshrc
    zstate completion fish > ~/.config/fish/completions/zstate.fish
    """
    from click.shell_completion import get_completion_class

    from zstate.cli.main import COMPLETION_VARIABLE, group

    kind = get_completion_class(shell)
    assert kind is not None
    source = kind(group, {}, "zstate", COMPLETION_VARIABLE).source().strip("\n")
    print_result(source.replace(*_CORRECTIONS[shell]) if shell in _CORRECTIONS else source)
