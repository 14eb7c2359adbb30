"""Two fidelities: many cheap runs carry the search and the emulator, few runs of the reference correct them."""
