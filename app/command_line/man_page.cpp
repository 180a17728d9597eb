#include "app/command_line/man_page.h"

#include <fmt/chrono.h>

#include <cstdlib>
#include <ctime>

#include "app/command_line/exit_codes.h"
#include "core/error.h"
#include "core/text.h"
#include "run/run_folder.h"

namespace semfield::app {

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
