"""From a prompt to the motion in it: what a text-to-motion model is asked for.

The paper keeps "only the relevant parts related to the motion" and adds a subject: "Iron man kicks
with his left leg" becomes "Someone kicks with the left leg". Here: the first verb of motion and
what follows it, up to the first comma or full stop, with "Someone" before it and "the" for "his",
"her", "its" and "their". A small list of rules, no language model: the user can always give the
text."""

import argparse
import re
from typing import Optional

SUBJECT = "Someone"
VERBS = (
    "aim balance bend bow box brace catch cartwheel celebrate charge cheer clap climb crawl "
    "crouch curtsy dance dash dive dodge draw"
    " drink drive duck eat embrace fall fight flex flip fly gallop gesture golf greet grab "
    "hang hit hold hop hug hurdle jab jog juggle"
    " jump kick kneel knock land lean leap lie lift limp look lunge march meditate move nod "
    "pace paddle perform pick pirouette play point"
    " pose practice practise pray pull punch push raise reach read recline rest ride roll row "
    "run salute shake shoot shout shrug shuffle"
    " sing sit skate ski skip slap sleep slide sneak spin sprint squat stand stagger step "
    "stomp stop stretch stride strike stroll strum"
    " stumble swim swing swipe talk tap throw tiptoe toss trot tumble turn twirl twist type "
    "wait walk wave wield work yawn yell"
).split()
DOUBLED = set(
    "clap flip hug hit hop jab jog nod pat run sit skip slap spin squat step stop strum swim tap "
    "trot".split()
)
"""Verbs whose last letter is written twice before "-ing"."""
POSSESSIVES = re.compile(r"\b(?:his|her|its|their|my|your|our)\b", re.IGNORECASE)


def third_person(verb: str) -> str:
    """ "kick" -> "kicks", "punch" -> "punches", "fly" -> "flies"."""
    if verb.endswith("y") and verb[-2] not in "aeiou":
        return verb[:-1] + "ies"
    return verb + ("es" if verb.endswith(("s", "sh", "ch", "x", "z", "o")) else "s")


def progressive(verb: str) -> str:
    """ "kick" -> "kicking", "run" -> "running", "ride" -> "riding", "lie" -> "lying"."""
    if verb.endswith("ie"):
        return verb[:-2] + "ying"
    if verb.endswith("e") and not verb.endswith(("ee", "oe")):
        return verb[:-1] + "ing"
    return verb + (verb[-1] if verb in DOUBLED else "") + "ing"


FORMS = {third_person(verb): verb for verb in VERBS}
PROGRESSIVES = {progressive(verb): verb for verb in VERBS}


def reduced_prompt(prompt: str) -> Optional[str]:
    """Return the motion of ``prompt`` as a sentence about someone; None when no verb of motion is
    found.

    A verb of the kind "kicks" comes before one of the kind "kicking", which may belong to the
    subject ("a flying fox jumps"), and both before one of the kind "kick", which may be a noun, and
    which becomes "kicks"."""
    for forms in (FORMS, PROGRESSIVES, {verb: verb for verb in VERBS}):
        for match in re.finditer(r"[A-Za-z]+", prompt):
            word = match.group().lower()
            if match.start() and word in forms:
                verb = f"is {word}" if forms is PROGRESSIVES else third_person(forms[word])
                clause = re.split(r"[,.;:!?]", prompt[match.end() :], maxsplit=1)[0]
                return " ".join(f"{SUBJECT} {verb} {POSSESSIVES.sub('the', clause)}".split())
    return None


def main() -> None:
    """Print the motion of the prompt on the command line."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {__spec__.name}",
        description="Print what a text-to-motion model is asked for a prompt.",
    )
    parser.add_argument("prompt", nargs="+", help="the prompt, as one argument or as words")
    prompt = " ".join(parser.parse_args().prompt)
    print(reduced_prompt(prompt) or "no verb of motion found: write the sentence yourself")


if __name__ == "__main__":
    main()
