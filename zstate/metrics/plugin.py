"""What metrics bring: nothing but the option --metrics of commands, which loads them."""

from zstate.plugins import Plugin

PLUGIN = Plugin("metrics")
