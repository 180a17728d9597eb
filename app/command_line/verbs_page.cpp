// The reference page of verbs.
#include "app/command_line/man_page.h"

namespace semfield::app {

namespace {

std::string cell(const std::string& text) {
  std::string out;
  for (const char c : text) out += c == '|' ? "\\|" : c == '<' ? "&lt;" : std::string(1, c);
  return out;
}

std::string table(const std::vector<const Word*>& words) {
  std::string text = "| word | meaning |\n|---|---|\n";
  for (const Word* word : words) text += "| `" + form_of(*word) + "` | " + cell(sentence_of(*word)) + " |\n";
  return text;
}

std::vector<const Word*> of(const std::vector<Word>& words) {
  std::vector<const Word*> out;
  for (const Word& word : words) out.push_back(&word);
  return out;
}

}  // namespace

std::string verbs_page(const Grammar& grammar) {
  std::string text =
      "# Verbs\n\n"
      "`semfield help VERB` prints the same, and so does `man semfield-VERB` where the package is installed.\n"
      "[command_line.md](command_line.md) has what holds for every verb, [json.md](json.md) the keys of `--json`.\n\n"
      "| verb | does |\n|---|---|\n";
  for (const VerbGrammar& verb : grammar.verbs) {
    std::string anchor = verb.name;
    for (char& c : anchor) c = c == ' ' ? '-' : c;
    text += "| [`" + verb.name + "`](#" + anchor + ") | " + cell(verb.sentence) + " |\n";
  }
  text += "\n## With every verb\n\n" + table(of(grammar.everywhere));
  for (const VerbGrammar& verb : grammar.verbs) {
    text += "\n## " + verb.name + "\n\n`" + usage_of(verb) + "`: " + verb.sentence + "." +
            (verb.json ? " Takes `--json`." : "") + "\n";
    if (!verb.words.empty()) text += "\n" + table(of(verb.words));
  }
  return text;
}

}  // namespace semfield::app
