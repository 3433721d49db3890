from zstate.following.placements import Placements

MOUNT, ROOM = ("r1", "mount"), ("r2", "room")


def test_who_places_the_same_is_named_until_it_does_not():
    placements = Placements()
    assert placements.replace(MOUNT, frozenset({"r1/a", "r1/b"})) == []
    assert placements.replace(ROOM, frozenset({"r1/c", "r1/b"})) == [("r1/b", [MOUNT])]
    assert placements.replace(MOUNT, frozenset({"r1/b"})) == [("r1/b", [ROOM])]
    assert placements.replace(ROOM, frozenset()) == []
    assert placements.replace(MOUNT, frozenset({"r1/a", "r1/b", "r1/c"})) == []
