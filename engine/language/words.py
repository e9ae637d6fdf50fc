"""Names of what the embedded encoder distinguishes, in English, German, French and Spanish.

Every entry is a string of words as `fold` writes them: lower case, without accents, in singular and plural unless the
plural follows the English rule.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping

THINGS: Mapping[str, str] = {
    "apple": "crabapple apfel aepfel pomme pommes manzana manzanas",
    "pear": "birne birnen poire poires pera peras",
    "cherry": (
        "cherries kirsche kirschen susskirsche susskirschen sauerkirsche sauerkirschen cerise cerises griotte griottes "
        "cereza cerezas guinda guindas"
    ),
    "plum": (
        "damson pflaume pflaumen zwetschge zwetschgen zwetsche zwetschen mirabelle mirabellen prune quetsche quetsches "
        "ciruela ciruelas"
    ),
    "lemon": "zitrone zitronen citron citrons limon limones",
    "orange": "apfelsine apfelsinen orangen naranja naranjas",
    "peach": (
        "peaches nectarine pfirsich pfirsiche nektarine nektarinen peche peches melocoton melocotones durazno duraznos "
        "nectarina nectarinas"
    ),
    "mango": "mangoes mangue mangues",
    "leaf": "leaves foliage leafage leaflet blatt blatter blaetter laub feuille feuilles feuillage hoja hojas follaje",
    "branch": ("branches twig limb bough shoot spur ast aste aeste zweig zweige branche rameau rameaux rama ramas"),
    "trunk": "stem bole bark stamm stamme staemme rinde tronc troncs ecorce tronco troncos corteza",
    "soil": "earth dirt mud clay erde terre tierra",
    "grass": "grasses lawn meadow turf weed gras graser wiese wiesen rasen herbe herbes gazon hierba pasto cesped",
    "sky": "skies cloud himmel wolke wolken ciel nuage nuages cielo nube nubes",
    "post": "pole stake pfosten pfahl pfahle stange stangen poteau poteaux piquet piquets poste estaca estacas",
    "hedge": (
        "hedgerow shrub bush hecke hecken strauch straucher straeucher haie haies buisson buissons seto setos arbusto "
        "arbustos"
    ),
    "flower": "blossom bloom blute bluten bluete blueten blume blumen fleur fleurs flor flores",
    "tag": "label etikett etiketten schild schilder etiquette etiquettes etiqueta etiquetas",
    "bucket": "pail eimer seau seaux cubo cubos balde baldes",
    "crate": "box boxes bin kiste kisten caisse caisses cageot cageots caja cajas cajon cajones",
    "ladder": "stepladder leiter leitern echelle echelles escalera escaleras",
    "stone": "rock boulder stein steine pierre pierres rocher rochers piedra piedras roca rocas",
    "wall": "mauer mauern wand wande waende muret murets muraille murailles muro muros pared paredes",
    "object": "item toy ball gegenstand gegenstande gegenstaende objekt objekte objet objets objeto objetos",
    "background": "backdrop floor table cloth hintergrund fond fondo",
    "fruit": "fruitlet frucht fruchte fruechte obst fruta frutas fruto frutos",
    "citrus": "citruses zitrusfrucht zitrusfruchte agrume agrumes citrico citricos",
    "plant": "vegetation pflanze pflanzen plante plantes planta plantas",
    "ground": "boden sol suelo",
    "tool": "equipment werkzeug werkzeuge gerat gerate geraet geraete outil outils herramienta herramientas",
}
"""Other names by concept; a concept is also its own name."""

COLOURS: Mapping[str, str] = {
    "red": ("crimson scarlet rot rote roter rotes roten rouge rouges rojo roja rojos rojas"),
    "orange": "naranja orangefarben anaranjado anaranjada",
    "yellow": "golden gold gelb gelbe gelber gelbes gelben jaune jaunes amarillo amarilla amarillos amarillas",
    "green": "grun grune gruner grunes grunen gruen gruene vert verte verts vertes verde verdes",
    "blue": "blau blaue blauer blaues blauen bleu bleue bleus bleues azul azules",
    "purple": "violet magenta lilac lila violett violette violetter violets violettes morado morada morados moradas",
    "pink": "rose rosa rosado rosada",
    "brown": "braun braune brauner braunes braunen brun brune bruns brunes marron marrones pardo parda",
    "white": "weiss weisse weisser weisses weissen blanc blanche blancs blanches blanco blanca blancos blancas",
    "grey": "gray grau graue grauer graues grauen gris grise grises",
    "black": "schwarz schwarze schwarzer schwarzes schwarzen noir noire noirs noires negro negra negros negras",
}
"""Other names by colour; a colour is also its own name."""

RIPENESS: Mapping[str, str] = {
    "ripe": "reif reife reifer reifes reifen mur mure murs mures maduro madura maduros maduras",
    "unripe": ("immature unreif unreife unreifer unreifes unreifen immatures inmaduro inmadura inmaduros inmaduras"),
}
"""Other names by ripeness; each is also its own name."""

FILLERS = frozenset(
    ("a", "an", "the", "some", "all")
    + ("ein", "eine", "einen", "der", "die", "das", "alle")
    + ("un", "une", "des", "le", "la", "les", "l", "d", "de")
    + ("el", "los", "las", "una", "unos", "unas")
)
"""Words without meaning in a prompt."""


def fold(word: str) -> str:
    """A word without capitals and accents: "Äpfel" → "apfel"."""
    decomposed = unicodedata.normalize("NFKD", word.casefold())
    return "".join(letter for letter in decomposed if not unicodedata.combining(letter))


def by_name(names: Mapping[str, str]) -> dict[str, str]:
    """{name: meaning} of all names."""
    return {name: meaning for meaning, others in names.items() for name in (meaning, *others.split())}
