#include "app/command_line/help.h"

#include <fmt/chrono.h>

#include <algorithm>
#include <cstdlib>
#include <ctime>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "app/command_line/exit_codes.h"
#include "app/verb.h"
#include "core/error.h"
#include "core/text.h"
#include "run/run_folder.h"

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

// The reference page of verbs.

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

namespace {

// Text of a line: hyphens can be copied, backslashes are no escapes, and a line begins with no control character.
std::string roff(const std::string& text) {
  std::string out = !text.empty() && (text.front() == '.' || text.front() == '\'') ? "\\&" : "";
  for (const char c : text) {
    if (c == '-') {
      out += "\\-";
    } else if (c == '\\') {
      out += "\\e";
    } else if (c == '\'') {
      out += "\\(aq";
    } else if (c == '`') {
      out += "\\(ga";
    } else {
      out += c;
    }
  }
  return out;
}

// A paragraph in lines of at most 80 bytes.
std::string paragraph(const std::string& text) {
  std::string out, line;
  for (const std::string_view word : words_of(text)) {
    const std::string longer = line + (line.empty() ? "" : " ") + std::string(word);
    if (!line.empty() && roff(longer).size() > 80) {
      out += roff(line) + "\n";
      line = word;
    } else {
      line = longer;
    }
  }
  return out + roff(line) + "\n";
}

std::string page_name(const VerbGrammar* verb) {
  std::string name = "semfield" + (verb == nullptr ? "" : "-" + verb->name);
  for (char& c : name) c = c == ' ' ? '-' : c;
  return name;
}

// Packages set SOURCE_DATE_EPOCH, so that the same sources give the same bytes.
std::string date() {
  const char* fixed = std::getenv("SOURCE_DATE_EPOCH");
  const std::time_t seconds = fixed != nullptr ? std::strtoll(fixed, nullptr, 10) : std::time(nullptr);
  return fmt::format("{:%Y-%m-%d}", fmt::gmtime(seconds));
}

std::string head(const VerbGrammar* verb, const std::string& sentence) {
  std::string title = page_name(verb);
  for (char& c : title) c = static_cast<char>(c >= 'a' && c <= 'z' ? c - 'a' + 'A' : c);
  return ".TH " + roff(title) + " 1 \"" + date() + "\" \"Semfield " + this_environment().version +
         "\" \"Semfield Manual\"\n.SH NAME\n" + roff(page_name(verb)) + " \\-\n" + paragraph(sentence);
}

// A word in bold and what stands for its value in italics.
std::string form(const Word& word) {
  if (word.kind == Word::Kind::operand) return ".I " + roff(word.value) + (word.many ? " ..." : "");
  std::string text = ".B" + std::string(word.value.empty() ? "" : "I") + " ";
  const std::string name = (word.letter.empty() ? "" : word.letter + ", ") + word.name;
  text += name.find(' ') == std::string::npos ? roff(name) : "\"" + roff(name) + "\"";
  return text + (word.value.empty() ? "" : " \" " + roff(word.value) + "\"");
}

std::string list(const std::string& title, const std::vector<const Word*>& words, bool operands) {
  std::string text;
  for (const Word* word : words) {
    if ((word->kind == Word::Kind::operand) == operands)
      text += ".TP\n" + form(*word) + "\n" + paragraph(sentence_of(*word));
  }
  return text.empty() ? "" : ".SH " + title + "\n" + text;
}

std::string verb_list(const Grammar& grammar, const std::string& group) {
  std::string text = ".SH VERBS\n";
  for (const VerbGrammar* verb : grammar.below(group)) {
    text += ".TP\n.BR " + roff(page_name(verb)) + " (1)\n" + paragraph(verb->sentence);
  }
  return text;
}

std::string see_also(const VerbGrammar* verb) {
  if (verb == nullptr) return "";
  const std::string parent = verb->parent();
  std::string text = ".SH SEE ALSO\n.BR semfield (1)";
  if (!parent.empty()) text += ",\n.BR " + roff("semfield-" + parent) + " (1)";
  return text + "\n";
}

std::string exit_status() {
  std::string text = ".SH EXIT STATUS\n";
  for (const auto& [code, meaning] : exit_codes()) text += ".TP\n.B " + code + "\n" + paragraph(meaning);
  return text;
}

}  // namespace

std::string man_file(const VerbGrammar* verb) { return page_name(verb) + ".1"; }

std::string man_page(const Grammar& grammar, const VerbGrammar* verb) {
  if (verb == nullptr) {
    return head(nullptr, "neural fields of appearance, geometry and semantics for one scene") +
           ".SH SYNOPSIS\n.B semfield\n.I VERB\n.RI [ WORDS ]\n.SH DESCRIPTION\n" +
           paragraph(
               "Semfield turns posed images of one scene and a few labels into a labelled scene. It trains a neural "
               "field, and renders colour, depth, class labels and their uncertainty for any view.") +
           ".PP\n" +
           paragraph(
               "Results go to the standard output, progress and remarks to the standard error. `semfield help VERB` "
               "prints the words of a verb.") +
           verb_list(grammar, "") + list("OPTIONS", grammar.options_of(nullptr), false) + exit_status();
  }
  const std::string usage = usage_of(*verb);
  std::string text = head(verb, verb->sentence) + ".SH SYNOPSIS\n.B semfield " + roff(verb->name) + "\n";
  if (usage.size() > verb->name.size() + 10) text += roff(usage.substr(verb->name.size() + 10)) + "\n";
  if (verb->group) return text + verb_list(grammar, verb->name) + see_also(verb);
  const std::vector<const Word*> words = grammar.words_of(*verb);
  return text + list("OPERANDS", words, true) + list("OPTIONS", words, false) + see_also(verb);
}

}  // namespace semfield::app
