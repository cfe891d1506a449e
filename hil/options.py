"""Options of the command line that several commands have."""

import click

profile_option = click.option(
    "--profile",
    default="floaty",
    show_default=True,
    metavar="NAME|FILE",
    help="A profile that ships, or a TOML file.",
)
set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="SECTION.KEY=VALUE",
    help="Override a value of the profile; repeatable.",
)
