"""Read scenario files: schema, given entries and their inheritance, derived entries, messages.

`load` reads, `given.inherit` puts changes on a base, `derive.derive` completes, `schema` validates.
Everything from `physics` up may import this folder; it imports `bodies` alone.
"""
