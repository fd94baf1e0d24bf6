"""From a prompt to the motion in it: what a text-to-motion model is asked for.

The paper keeps "only the relevant parts related to the motion" and adds a subject: "Iron man kicks
with his left leg" becomes "Someone kicks with the left leg". Here: the first verb of motion and
what follows it, up to the first comma or full stop, with "Someone" before it and "the" for "his",
"her", "its" and "their". A small list of rules, no language model: the user can always give the
text."""

import re
import sys
from typing import Optional

SUBJECT = "Someone"
VERBS = (
    "aim balance bend bow box brace catch cartwheel celebrate charge cheer clap climb crawl crouch "
    "curtsy dance dash dive dodge draw drink drive duck eat embrace fall fight flex flip fly "
    "gallop gesture golf greet grab hang hit hold hop hug hurdle jab jog juggle jump kick kneel "
    "knock land lean leap lie lift limp look lunge march meditate move nod pace paddle perform "
    "pick pirouette play point pose practice practise pray pull punch push raise reach read "
    "recline rest ride roll row run salute shake shoot shout shrug shuffle sing sit skate ski skip "
    "slap sleep slide sneak spin sprint squat stand stagger step stomp stop stretch stride strike "
    "stroll strum stumble swim swing swipe talk tap throw tiptoe toss trot tumble turn twirl twist "
    "type wait walk wave wield work yawn yell"
).split()
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
    """Return the motion of ``prompt`` as a sentence about someone; None when no verb of motion is
    found.

    A verb of the kind "kicks" comes before one of the kind "kicking", which may belong to the
    subject ("a flying fox jumps"), and both before one of the kind "kick", which may be a noun, and
    which becomes "kicks"."""
    for is_verb, form in (
        (THIRD_PERSONS.__contains__, str),
        (is_progressive, "is {}".format),
        (VERBS.__contains__, third_person),
    ):
        for match in re.finditer(r"[A-Za-z]+", prompt):
            word = match.group().lower()
            if match.start() and is_verb(word):
                clause = re.split(r"[,.;:!?]", prompt[match.end() :], maxsplit=1)[0]
                return " ".join(f"{SUBJECT} {form(word)} {POSSESSIVES.sub('the', clause)}".split())
    return None


def main() -> None:
    """Print the motion of the prompt on the command line, one argument or words."""
    prompt = " ".join(sys.argv[1:])
    print(reduced_prompt(prompt) or "no verb of motion found: write the sentence yourself")


if __name__ == "__main__":
    main()
