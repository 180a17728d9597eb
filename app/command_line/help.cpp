#include "app/command_line/help.h"

#include <algorithm>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "app/verb.h"
#include "core/error.h"
#include "core/text.h"

namespace semfield::app {

namespace {

constexpr std::size_t kWidth = 100, kSentencesAt = 28;

using Row = std::pair<std::string, std::string>;

// A name and its sentence, which is wrapped.
std::string row_text(const Row& row) {
  std::string text = "  " + row.first;
  if (text.size() + 2 > kSentencesAt) {
    text += "\n" + std::string(kSentencesAt, ' ');
  } else {
    text.append(kSentencesAt - text.size(), ' ');
  }
  std::size_t column = kSentencesAt;
  for (const std::string_view word : words_of(row.second)) {
    if (column > kSentencesAt && column + 1 + word.size() > kWidth) {
      text += "\n" + std::string(kSentencesAt, ' ');
      column = kSentencesAt;
    } else if (column > kSentencesAt) {
      text += ' ';
      ++column;
    }
    text += word;
    column += word.size();
  }
  return text + "\n";
}

std::string section(const std::string& title, const std::vector<Row>& rows) {
  if (rows.empty()) return "";
  std::string text = "\n" + title + ":\n";
  for (const Row& row : rows) text += row_text(row);
  return text;
}

std::vector<Row> rows_of(const std::vector<const Word*>& words, bool operands) {
  std::vector<Row> rows;
  for (const Word* word : words) {
    if ((word->kind == Word::Kind::operand) != operands) continue;
    // Letters stand in a column of their own.
    const bool indented = !operands && word->letter.empty();
    rows.emplace_back((indented ? "    " : "") + form_of(*word), sentence_of(*word));
  }
  return rows;
}

std::vector<const Word*> pointers(const std::vector<Word>& words) {
  std::vector<const Word*> out;
  for (const Word& word : words) out.push_back(&word);
  return out;
}

std::vector<Row> verb_rows(const std::vector<const VerbGrammar*>& verbs) {
  std::vector<Row> rows;
  for (const VerbGrammar* verb : verbs) rows.emplace_back(verb->last(), verb->sentence);
  return rows;
}

std::vector<std::string> names_below(const Grammar& grammar, const std::string& group) {
  std::vector<std::string> names;
  for (const VerbGrammar* verb : grammar.below(group)) names.push_back(verb->last());
  return names;
}

std::vector<std::string> flags_of(const std::vector<const Word*>& words) {
  std::vector<std::string> flags;
  for (const Word* word : words) {
    if (word->kind != Word::Kind::operand) flags.push_back(word->name);
  }
  return flags;
}

// Verbs that have the flag, as they are typed.
std::vector<std::string> verbs_with(const Grammar& grammar, const std::string& flag) {
  std::vector<std::string> verbs;
  for (const VerbGrammar& verb : grammar.verbs) {
    for (const Word& word : verb.words) {
      if (word.name == flag) verbs.push_back(command(verb.name));
    }
  }
  return verbs;
}

// The flag that `flag` was probably meant to be; "": none is near.
std::string closest_flag(const std::string& flag, const std::vector<std::string>& known) {
  std::vector<std::string> bare;
  for (const std::string& name : known) bare.push_back(name.substr(2));
  const std::string word = flag.substr(std::min(flag.find_first_not_of('-'), flag.size()));
  // One dash too few, or cut short.
  for (const std::string& name : bare) {
    if (name == word || (word.size() >= 3 && name.starts_with(word))) return "--" + name;
  }
  const std::string near = did_you_mean(word, bare);
  return near.empty() ? "" : "--" + near;
}

}  // namespace

std::string program_help(const Grammar& grammar) {
  return "Semfield: neural fields of appearance, geometry and semantics for one scene\n\n"
         "Usage: " +
         program_name() + " VERB [WORDS]\n" + section("Verbs", verb_rows(grammar.below(""))) +
         section("With every verb", rows_of(pointers(grammar.everywhere), false)) + "\n" + command("help VERB") +
         " prints the words of a verb. The code at the end of an error is one of docs/reference/codes.md.\n";
}

std::string verb_help(const Grammar& grammar, const VerbGrammar& verb) {
  std::string text = "Usage: " + usage_of(verb) + "\n\n" + verb.sentence + "\n";
  if (verb.group) {
    return text + section("Verbs", verb_rows(grammar.below(verb.name))) + "\n" +
           command("help " + verb.name + " VERB") + " prints the words of a verb.\n";
  }
  std::vector<const Word*> own = pointers(verb.words), all = grammar.words_of(verb);
  const std::vector<const Word*> rest(all.begin() + static_cast<std::ptrdiff_t>(own.size()), all.end());
  return text + section("Operands", rows_of(own, true)) + section("Options", rows_of(own, false)) +
         section(verb.json ? "Also" : "With every verb", rows_of(rest, false));
}

const VerbGrammar* verb_named(const Grammar& grammar, const std::vector<std::string>& words) {
  const VerbGrammar* named = nullptr;
  for (const std::string& word : words) {
    const std::string group = named == nullptr ? "" : named->name;
    const VerbGrammar* next = grammar.find(group.empty() ? word : group + " " + word);
    if (next == nullptr) throw unknown_verb(grammar, group, word);
    named = next;
  }
  return named;
}

Error unknown_verb(const Grammar& grammar, const std::string& group, const std::string& word) {
  const std::string head = group.empty() ? "" : group + " ";
  const std::string text = "there is no verb '" + head + word + "'";
  // Verbs that were measurements for documents.
  static const std::map<std::string, std::string> studies{
      {"quadrature", "quadrature"}, {"pairs", "leave_out"}, {"scale", "scale"}, {"label", "labelling"}};
  if (const auto study = studies.find(word); group == "bench" && study != studies.end())
    return {ErrorKind::usage, "usage.verb.unknown", text, "run studies/" + study->second + ".py of the source tree"};
  if (const std::string near = did_you_mean(word, names_below(grammar, group)); !near.empty())
    return {ErrorKind::usage, "usage.verb.unknown", text, "did you mean " + command(head + near) + "?"};
  for (const VerbGrammar* other : grammar.below("")) {
    const std::string near = did_you_mean(word, names_below(grammar, other->name));
    if (!near.empty())
      return {ErrorKind::usage, "usage.verb.unknown", text, "did you mean " + command(other->name + " " + near) + "?"};
  }
  return {ErrorKind::usage, "usage.verb.unknown", text,
          command("help" + (group.empty() ? "" : " " + group)) + " lists the verbs"};
}

Error unknown_flag(const Grammar& grammar, const std::string& verb, const std::string& word) {
  const VerbGrammar* of = grammar.find(verb);
  const std::string flag = word.substr(0, word.find('='));
  const std::string text = (verb.empty() ? "no verb before the flag " : verb + " has no flag ") + flag;
  std::vector<const Word*> own = pointers(grammar.everywhere);
  for (const Word* w : of != nullptr ? grammar.words_of(*of) : std::vector<const Word*>()) own.push_back(w);
  const std::vector<std::string> others = verbs_with(grammar, flag);
  if (!others.empty()) {
    const std::vector<std::string> first(others.begin(),
                                         others.begin() + std::min<std::ptrdiff_t>(4, std::ssize(others)));
    return {ErrorKind::usage, "usage.flag.unknown", text,
            "it belongs to " + (others.size() > first.size() ? join(first) + " and others" : one_of(first)) +
                (verb.empty() ? ", and comes after the verb" : "")};
  }
  if (const std::string near = closest_flag(flag, flags_of(own)); !near.empty())
    return {ErrorKind::usage, "usage.flag.unknown", text, "did you mean " + near + "?"};
  std::vector<std::string> all;
  for (const VerbGrammar& other : grammar.verbs) {
    for (const std::string& name : flags_of(pointers(other.words))) all.push_back(name);
  }
  if (const std::string near = closest_flag(flag, all); !near.empty())
    return {ErrorKind::usage, "usage.flag.unknown", text,
            "did you mean " + near + " of " + verbs_with(grammar, near).front() + "?"};
  return {ErrorKind::usage, "usage.flag.unknown", text, "see " + command("help" + (verb.empty() ? "" : " " + verb))};
}

Error no_json(const Grammar& grammar, const VerbGrammar& verb) {
  std::vector<std::string> have;
  for (const VerbGrammar& other : grammar.verbs) {
    if (other.json) have.push_back(other.name);
  }
  return {ErrorKind::usage, "usage.json.none", verb.name + " takes no --json", "these verbs do: " + join(have)};
}

}  // namespace semfield::app
