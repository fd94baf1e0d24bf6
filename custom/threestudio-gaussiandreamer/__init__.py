"""The drop-in for a threestudio checkout: copy this folder into its ``custom/`` and install the
package beside it.

Importing it enters our parts into the host's registry, where configurations find them by name. In
our own launcher, which has entered them already, it does nothing."""

import threestudio_gaussiandreamer

threestudio_gaussiandreamer.register_parts()
