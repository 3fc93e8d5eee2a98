"""What a command is called: the one that was meant, and the kinds that a shell completes."""

from __future__ import annotations

from collections.abc import Callable

import click

from softneck.core._errors import did_you_mean

from ._moved import now


class NearGroup(click.Group):
    """A group whose error on an unknown command names the new one of an old name, else the nearest one."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that `args` begin with, as click does."""
        name, known = args[0], self.list_commands(ctx)
        if not ctx.resilient_parsing and not name.startswith("-") and name not in known:
            if new := now(ctx, name):
                raise click.UsageError(f"there is no command `{name}` any more: {new}", ctx)
            hint = did_you_mean(name, known) or f"the commands are {', '.join(known)}."
            raise click.UsageError(f"no such command `{name}`; {hint.rstrip()}", ctx)
        return super().resolve_command(ctx, args)


def kinds_complete(role: str, *more: str) -> Callable[[click.Context, click.Parameter, str], list[str]]:
    """Return what completes the kinds of `role` and `more` in a shell."""

    def complete(_ctx: click.Context, _param: click.Parameter, begun: str) -> list[str]:
        # Here, for it imports NumPy: the command line sets the number of its threads first.
        from softneck.core._kinds import kinds_of

        return [name for name in (*kinds_of(role), *more) if name.startswith(begun)]

    return complete
