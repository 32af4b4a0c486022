"""Letters, signs and turned pieces."""

from milx.envs.shapes.primitives import Box, Capsule, Cylinder, Ellipsoid, ball, shape, strokes, turned

LETTERS = {
    "letter_a": strokes("-0.8,-1 0,1 0.8,-1|-0.45,-0.2 0.45,-0.2"),
    "letter_c": strokes("0.7,1 -0.6,0.7 -0.6,-0.7 0.7,-1"),
    "letter_e": strokes("0.7,1 -0.6,1 -0.6,-1 0.7,-1|-0.6,0 0.5,0"),
    "letter_f": strokes("0.7,1 -0.6,1 -0.6,-1|-0.6,0.1 0.5,0.1"),
    "letter_h": strokes("-0.6,1 -0.6,-1|0.6,1 0.6,-1|-0.6,0 0.6,0"),
    "letter_i": strokes("0,1 0,-1"),
    "letter_j": strokes("0.5,1 0.5,-0.7 -0.1,-1 -0.6,-0.6"),
    "letter_k": strokes("-0.6,1 -0.6,-1|0.6,1 -0.6,0 0.6,-1"),
    "letter_l": strokes("-0.5,1 -0.5,-1 0.7,-1"),
    "letter_m": strokes("-0.9,-1 -0.7,1 0,-0.3 0.7,1 0.9,-1"),
    "letter_n": strokes("-0.6,-1 -0.6,1 0.6,-1 0.6,1"),
    "letter_p": strokes("-0.5,-1 -0.5,1 0.6,0.6 -0.5,0.1"),
    "letter_t": strokes("-0.8,1 0.8,1|0,1 0,-1"),
    "letter_u": strokes("-0.6,1 -0.6,-0.9 0.6,-0.9 0.6,1"),
    "letter_v": strokes("-0.7,1 0,-1 0.7,1"),
    "letter_w": strokes("-0.9,1 -0.5,-1 0,0.4 0.5,-1 0.9,1"),
    "letter_x": strokes("-0.7,1 0.7,-1|0.7,1 -0.7,-1"),
    "letter_y": strokes("-0.7,1 0,0 0.7,1|0,0 0,-1"),
    "letter_z": strokes("-0.7,1 0.7,1 -0.7,-1 0.7,-1"),
}

SIGNS = {
    "digit_four": strokes("0.4,-1 0.4,1 -0.7,-0.3 0.8,-0.3"),
    "digit_seven": strokes("-0.6,1 0.7,1 -0.2,-1"),
    "plus": strokes("-1,0 1,0|0,-1 0,1", 0.22),
    "asterisk": strokes("-1,0 1,0|-0.5,0.87 0.5,-0.87|0.5,0.87 -0.5,-0.87", 0.15),
    "arrow": strokes("-1,0 1,0|0.4,0.6 1,0 0.4,-0.6"),
    "tick": strokes("-0.9,0 -0.3,-0.8 0.9,0.9", 0.2),
    "lightning": strokes("0.4,1 -0.4,0.1 0.4,-0.1 -0.3,-1"),
    "triangle": strokes("-0.9,-0.6 0.9,-0.6 0,0.95 -0.9,-0.6"),
    "square": strokes("-0.7,-0.7 0.7,-0.7 0.7,0.7 -0.7,0.7 -0.7,-0.7"),
    "diamond": strokes("-0.6,0 0,1 0.6,0 0,-1 -0.6,0"),
    "pi": strokes("-0.9,0.7 0.9,0.7|-0.4,0.7 -0.4,-0.9|0.4,0.7 0.4,-0.9"),
    "trident": strokes("0,-1 0,1|-0.7,1 -0.6,0.1 0.6,0.1", 0.15),
    "hook": strokes("0,1 0,-0.5 0.5,-0.9 0.9,-0.4", 0.2),
    "anchor": shape(
        Capsule(0, -0.8, 0, 0.8, 0.15),
        Capsule(-0.8, -0.3, 0, -0.9, 0.15),
        Capsule(0.8, -0.3, 0, -0.9, 0.15),
        ball(0, 0.9, 0.25),
    ),
}

TURNED = {
    "pawn": turned(("cylinder", 0.55, 0.2), ("cylinder", 0.4, 0.7), ("cylinder", 0.22, 0.6), ("ellipsoid", 0.4, 0.7)),
    "rook": turned(("cylinder", 0.6, 0.2), ("cylinder", 0.4, 1.4), ("cylinder", 0.55, 0.5)),
    "bishop": turned(
        ("cylinder", 0.55, 0.2), ("cylinder", 0.35, 0.7), ("ellipsoid", 0.42, 1.1), ("ellipsoid", 0.12, 0.24)
    ),
    "queen": turned(
        ("cylinder", 0.6, 0.2),
        ("cylinder", 0.4, 0.9),
        ("cylinder", 0.25, 0.7),
        ("ellipsoid", 0.5, 0.5),
        ("ellipsoid", 0.2, 0.3),
    ),
    "king": turned(("cylinder", 0.6, 0.2), ("cylinder", 0.42, 1.6), ("ellipsoid", 0.5, 0.4), ("cylinder", 0.12, 0.5)),
    "bottle": turned(("cylinder", 0.5, 0.2), ("cylinder", 0.5, 1.4), ("ellipsoid", 0.45, 0.4), ("cylinder", 0.18, 0.7)),
    "vase": turned(("cylinder", 0.4, 0.2), ("ellipsoid", 0.6, 1.2), ("cylinder", 0.25, 0.4), ("cylinder", 0.4, 0.12)),
    "candle": turned(
        ("cylinder", 0.6, 0.2), ("cylinder", 0.55, 0.15), ("cylinder", 0.25, 1.5), ("ellipsoid", 0.1, 0.4)
    ),
    "lamp": turned(("cylinder", 0.55, 0.2), ("cylinder", 0.12, 1.2), ("cylinder", 0.6, 0.7)),
    "goblet": turned(("cylinder", 0.55, 0.2), ("cylinder", 0.12, 0.8), ("ellipsoid", 0.55, 0.9)),
    "mushroom": turned(("cylinder", 0.35, 0.2), ("cylinder", 0.3, 0.7), ("ellipsoid", 0.75, 0.7)),
    "bell": turned(("cylinder", 0.75, 0.2), ("cylinder", 0.6, 0.5), ("ellipsoid", 0.5, 0.6), ("ellipsoid", 0.15, 0.3)),
    "jar": turned(("cylinder", 0.6, 0.2), ("cylinder", 0.6, 1.2), ("cylinder", 0.45, 0.3)),
    "barrel": turned(("cylinder", 0.6, 0.2), ("ellipsoid", 0.7, 1.8), ("cylinder", 0.5, 0.1)),
    "lighthouse": turned(
        ("cylinder", 0.6, 0.2), ("cylinder", 0.45, 1.2), ("cylinder", 0.32, 0.9), ("ellipsoid", 0.35, 0.5)
    ),
    "top": turned(("cylinder", 0.2, 0.2), ("ellipsoid", 0.8, 0.6), ("cylinder", 0.12, 0.6)),
    "hat": turned(("cylinder", 0.9, 0.2), ("cylinder", 0.5, 0.7), ("ellipsoid", 0.5, 0.4)),
    "cake": turned(("cylinder", 0.85, 0.2), ("cylinder", 0.8, 0.5), ("cylinder", 0.5, 0.45), ("cylinder", 0.1, 0.4)),
    "snowman": turned(
        ("cylinder", 0.65, 0.2), ("ellipsoid", 0.6, 0.9), ("ellipsoid", 0.45, 0.8), ("ellipsoid", 0.3, 0.6)
    ),
    "buoy": turned(("cylinder", 0.7, 0.2), ("ellipsoid", 0.7, 0.8), ("cylinder", 0.2, 0.8), ("ellipsoid", 0.2, 0.3)),
    "plant": turned(("cylinder", 0.5, 0.2), ("cylinder", 0.55, 0.6), ("ellipsoid", 0.7, 1.1)),
    "ice_cream": turned(
        ("cylinder", 0.25, 0.2), ("cylinder", 0.3, 0.9), ("ellipsoid", 0.55, 0.9), ("ellipsoid", 0.15, 0.3)
    ),
    "knight": shape(
        ball(0, 0, 0.6),
        Cylinder(0, 0, 0.7, 0.4, 0.35),
        Ellipsoid(0, 0.1, 1.5, 0.28, 0.4, 0.6),
        Ellipsoid(0, 0.35, 1.85, 0.2, 0.4, 0.22),
        Box(0, -0.3, 1.7, 0.08, 0.12, 0.4),
    ),
}
