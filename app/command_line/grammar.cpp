#include "app/command_line/grammar.h"

#include <algorithm>
#include <tuple>

#include "app/verb.h"
#include "core/error.h"

namespace semfield::app {

namespace {

// A group stands before its verbs, and these by their own ranks.
std::vector<Verb> ordered_verbs() {
  std::vector<Verb> verbs = all_verbs();
  const std::vector<Verb> unordered = verbs;
  const auto rank_of_top = [&](const std::string& name) {
    const auto top = std::find_if(unordered.begin(), unordered.end(),
                                  [&](const Verb& verb) { return verb.name == name.substr(0, name.find(' ')); });
    return top == unordered.end() ? 0 : top->rank;
  };
  std::sort(verbs.begin(), verbs.end(), [&](const Verb& a, const Verb& b) {
    const auto key = [&](const Verb& verb) {
      const bool below = verb.name.find(' ') != std::string::npos;
      return std::make_tuple(rank_of_top(verb.name), verb.name.substr(0, verb.name.find(' ')), below, verb.rank,
                             std::cref(verb.name));
    };
    return key(a) < key(b);
  });
  return verbs;
}

Word word_of_all(Word::Kind kind, std::string name, std::string letter, std::string value, std::string help) {
  Word word;
  word.kind = kind;
  word.name = std::move(name);
  word.letter = std::move(letter);
  word.value = std::move(value);
  word.help = std::move(help);
  return word;
}

std::vector<Word> words_everywhere(GlobalOptions& global) {
  Word quiet = word_of_all(Word::Kind::flag, "--quiet", "-q", "", "print no progress and no notes");
  quiet.take = [&global](const std::string&) {
    global.quiet = true;
    return std::string();
  };
  Word json = word_of_all(Word::Kind::flag, "--json", "", "",
                          "print the results as one JSON object on stdout, if the verb has any");
  json.take = [&global](const std::string&) {
    global.json = true;
    return std::string();
  };
  Word plugin = word_of_all(Word::Kind::value, "--plugin", "", "FILE", "load a plugin module first");
  plugin.many = true;
  plugin.take = [&global](const std::string& value) {
    global.modules.push_back(value);
    return std::string();
  };
  // The parser itself knows what these two do.
  Word help = word_of_all(Word::Kind::flag, "--help", "-h", "", "print this help");
  Word version = word_of_all(Word::Kind::flag, "--version", "", "",
                             "print version, compiler, plugin interface and instruction sets");
  return {std::move(quiet), std::move(json), std::move(plugin), std::move(help), std::move(version)};
}

}  // namespace

std::string VerbGrammar::parent() const { return name.substr(0, std::max<std::size_t>(name.find(' ') + 1, 1) - 1); }
std::string VerbGrammar::last() const { return name.substr(name.find(' ') + 1); }

std::vector<const Word*> VerbGrammar::operands() const {
  std::vector<const Word*> out;
  for (const Word& word : words) {
    if (word.kind == Word::Kind::operand) out.push_back(&word);
  }
  return out;
}

const VerbGrammar* Grammar::find(const std::string& name) const {
  const auto found = std::find_if(verbs.begin(), verbs.end(), [&](const VerbGrammar& v) { return v.name == name; });
  return found == verbs.end() ? nullptr : &*found;
}

std::vector<const VerbGrammar*> Grammar::below(const std::string& group) const {
  std::vector<const VerbGrammar*> out;
  for (const VerbGrammar& verb : verbs) {
    if (verb.parent() == group) out.push_back(&verb);
  }
  return out;
}

std::vector<const Word*> Grammar::words_of(const VerbGrammar& verb) const {
  std::vector<const Word*> out;
  for (const Word& word : verb.words) out.push_back(&word);
  for (const Word& word : everywhere) {
    if (word.name != "--version" && (word.name != "--json" || verb.json)) out.push_back(&word);
  }
  return out;
}

std::vector<const Word*> Grammar::options_of(const VerbGrammar* verb) const {
  std::vector<const Word*> out;
  if (verb == nullptr) {
    for (const Word& word : everywhere) out.push_back(&word);
  } else {
    for (const Word* word : words_of(*verb)) {
      if (word->kind != Word::Kind::operand) out.push_back(word);
    }
  }
  return out;
}

Grammar program_grammar(GlobalOptions& global) {
  Grammar grammar;
  grammar.everywhere = words_everywhere(global);
  for (const Verb& verb : ordered_verbs()) {
    VerbGrammar made;
    made.name = verb.name;
    made.sentence = verb.sentence;
    made.group = !verb.declare;
    made.json = verb.json;
    made.launch = verb.launch;
    if (verb.declare) {
      VerbWords words(made);
      made.run = verb.declare(words);
    }
    grammar.verbs.push_back(std::move(made));
  }
  return grammar;
}

const Grammar& program_grammar() {
  static GlobalOptions nobody;
  static const Grammar grammar = program_grammar(nobody);
  return grammar;
}

std::string one_of(const std::vector<std::string>& words) {
  if (words.size() < 2) return join(words);
  return join(std::vector<std::string>(words.begin(), words.end() - 1)) + " or " + words.back();
}

std::string sentence_of(const Word& word) {
  std::vector<std::string> facts;
  if (!word.range.empty()) facts.push_back(word.range);
  const bool says_default = word.help.find("(default: ") != std::string::npos;
  if (!word.initial.empty() && !says_default) facts.push_back("default: " + word.initial);
  if (word.required && word.kind == Word::Kind::value) facts.push_back("required");
  return word.help + (facts.empty() ? "" : " (" + join(facts, "; ") + ")");
}

std::string form_of(const Word& word) {
  if (word.kind == Word::Kind::operand) {
    const std::string name = word.value + (word.many ? "..." : "");
    return word.required ? name : "[" + name + "]";
  }
  return (word.letter.empty() ? "" : word.letter + ", ") + word.name + (word.value.empty() ? "" : " " + word.value);
}

std::string command(const std::string& words) { return "`" + program_name() + " " + words + "`"; }

std::string usage_of(const VerbGrammar& verb) {
  std::string text = program_name() + " " + verb.name;
  if (verb.group) return text + " VERB";
  bool options = false;
  for (const Word& word : verb.words) {
    options = options || word.kind != Word::Kind::operand;
    if (word.kind == Word::Kind::operand || word.required) text += " " + form_of(word);
  }
  return text + (options ? " [OPTIONS]" : "");
}

ValueFiles files_of(const Word& word) {
  for (const char* name : {"FILE", "PATH", "CONFIG", "TABLE", "PAGE", "PROGRAM"}) {  // "CONFIG_A" too
    if (word.value.starts_with(name)) return ValueFiles::files;
  }
  for (const char* name : {"FOLDER", "RUN"}) {
    if (word.value.starts_with(name)) return ValueFiles::folders;
  }
  return ValueFiles::none;
}

}  // namespace semfield::app
