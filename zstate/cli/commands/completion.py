"""zstate completion: what teaches a shell to complete commands."""

from __future__ import annotations

import click

from zstate.cli.console import say


@click.command("completion")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion_command(shell: str) -> None:
    """Print what makes SHELL complete commands, options, models, files and announced robots.

    \b
    eval "$(zstate completion bash)"                   # now; in ~/.bashrc for good
    eval "$(zstate completion zsh)"                    # in ~/.zshrc
    zstate completion fish > ~/.config/fish/completions/zstate.fish
    """
    from click.shell_completion import get_completion_class

    from zstate.cli.main import COMPLETION_VARIABLE, group

    kind = get_completion_class(shell)
    assert kind is not None
    say(kind(group, {}, "zstate", COMPLETION_VARIABLE).source().strip("\n"))
