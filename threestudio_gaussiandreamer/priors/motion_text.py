"""From a prompt to the motion in it: what a text-to-motion model is asked for.

The paper keeps "only the relevant parts related to the motion" and adds a subject: "Iron man kicks
with his left leg" becomes "Someone kicks with the left leg". Here: the first verb of motion and
what follows it, up to the first comma or full stop, with "Someone" before it and "the" for "his",
"her", "its" and "their". No language model: the user can always give the text.

A model may list the phrases of its training, as the toybox's: the first in that sentence, or else
in the prompt from its verb on, is taken."""

import re
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from typing import Optional

from ..core.errors import UserError

SUBJECT = "Someone"
VERBS = (
    "aim balance bend bow box brace catch cartwheel celebrate charge cheer clap climb crawl crouch "
    "curtsy dance dash dive dodge draw drink drive duck eat embrace fall fight flex flip fly "
    "gallop gesture golf greet grab hang hit hold hop hug hurdle jab jog juggle jump kick kneel "
    "knock land lean leap lie lift limp look lunge march meditate move nod open pace paddle "
    "perform pick pirouette play point pose practice practise pray pull punch push raise reach "
    "read recline rest ride roll row run salute shake shoot shout shrug shuffle sing sit skate ski "
    "skip slap sleep slide sneak spin sprint squat stand stagger step stomp stop stretch stride "
    "strike stroll strum stumble swim swing swipe talk tap throw tiptoe toss trot tumble turn "
    "twirl twist type wait walk wave wield work yawn yell"
).split()
CLOTHES = (
    "armou?r boots cape cap cloak coat dress gloves hat helmet hoodie jacket jeans pants robe "
    "scarf shirt shoes skirt suit sweater trousers uniform"
).replace(" ", "|")
DRESSED = re.compile(
    r"\b(?:while\s+)?(?:wearing|dressed|clad)\b.*"
    rf"|\b(?:in|with)\s+(?:(?!(?:in|with)\b)[\w-]+\s+){{0,4}}(?:{CLOTHES})\b.*",
    re.IGNORECASE | re.DOTALL,
)
PERSON = "(?:person|man|woman|boy|girl|child)"
SEVERAL = re.compile(
    r"^ (?:.*(?:photo|picture|image|model|render|rendering) of )?"
    r"(?:two(?! face)|three|four|five|several|many) "
    r"| (?:people|persons|(?<! x )men|women|boys|girls|children|twins|couple(?! of)|each other) "
    rf"| {PERSON} .*(?:and|with) (?:a|an|another) (?:\w+ ){{0,2}}{PERSON} (?!s )"
    # Batman and Robin run; but a man with a sword and a bow runs
    rf"|^(?!.* (?:{'|'.join(VERBS)})e?s ).* and (?:an? )?(?!(?:can|may|then|to) )\w+"
    rf" (?:{'|'.join(VERBS)}) "
)
POSSESSIVES = re.compile(r"\b(?:his|her|its|their|my|your|our)\b", re.IGNORECASE)


def third_person(verb: str) -> str:
    """ "kick" -> "kicks", "punch" -> "punches", "fly" -> "flies"."""
    if verb.endswith("y") and verb[-2] not in "aeiou":
        return verb[:-1] + "ies"
    return verb + ("es" if verb.endswith(("s", "sh", "ch", "x", "z", "o")) else "s")


def is_progressive(word: str) -> bool:
    """Return whether a word is one as "kicking", "running", "riding" or "lying"."""
    stem = word.removesuffix("ing")
    once = stem[:-1] if stem[-1:] == stem[-2:-1] else stem
    return stem != word and not {stem, once, f"{stem}e", f"{stem[:-1]}ie"}.isdisjoint(VERBS)


THIRD_PERSONS = set(map(third_person, VERBS))


def reduced_prompt(prompt: str) -> Optional[str]:
    """Return the motion of ``prompt`` as a sentence about someone; None without a verb of motion.

    A verb of the kind "kicks" comes before one of the kind "kicking", which may be the subject's
    ("a flying fox jumps"), and both before "kick", which may be a noun and becomes "kicks"."""
    for is_verb, form in (
        (THIRD_PERSONS.__contains__, str),
        (is_progressive, "is {}".format),
        (VERBS.__contains__, third_person),
    ):
        for match in re.finditer(r"[A-Za-z]+", prompt):
            word = match.group().lower()
            if match.start() and is_verb(word):
                clause = re.split(r"[,.;:!?]", prompt[match.end() :], maxsplit=1)[0]
                clause = DRESSED.sub("", clause)
                return " ".join(f"{SUBJECT} {form(word)} {POSSESSIVES.sub('the', clause)}".split())
    return None


def motion_sentence(prompt: str, known: Sequence[str] = ()) -> str:
    """Return the sentence to ask a text-to-motion model for.

    Args:
        known: phrases that the model was trained on ("kicks with the left leg"); empty for any.

    Raises:
        UserError: the prompt has no action, none of the known ones, or more than one person.
    """
    if SEVERAL.search(plain(prompt)):
        raise UserError(
            f"the prompt {prompt!r} is about more than one person: a run makes one; set "
            "motion_text to what this one does"
        )
    sentence = reduced_prompt(prompt)
    action = (sentence or prompt).removeprefix(f"{SUBJECT} ").removeprefix("is ")
    verb = action.partition(" ")[0]
    for text in map(plain, (sentence or "", prompt[max(prompt.lower().find(verb), 0) :])):
        keys = [plain(phrase.removeprefix("is ")) for phrase in known]
        if found := [key for key in keys if key in text]:
            first = min(found, key=lambda key: (text.index(key), -len(key)))
            return f"{SUBJECT} {known[keys.index(first)]}"
    if sentence and not known:
        return sentence
    alike = [phrase for phrase in known if phrase.split()[0] == verb]
    near = get_close_matches(action, alike or known, 3, cutoff=0) or ["stands with open arms"]
    if sentence:
        names = ", ".join(map(repr, near))
        raise UserError(f"the model doesn't know the action {action!r}: near {names}")
    raise UserError(
        f"no action was found in {prompt!r}: say what the person does, or set motion_text, for "
        f"instance to '{SUBJECT} {near[0]}'"
    )


def plain(text: str) -> str:
    """Return the words in lower case between spaces, without articles that vary."""
    words = re.findall(r"[^\W_]+", POSSESSIVES.sub("the", text.lower()))
    return f" {' '.join(word for word in words if word != 'the')} "


def main() -> None:
    """Print the motion of the prompt on the command line, one argument or words."""
    prompt = " ".join(sys.argv[1:])
    print(reduced_prompt(prompt) or "no verb of motion found: write the sentence yourself")


if __name__ == "__main__":
    main()
