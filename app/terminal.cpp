#include "app/terminal.h"

#include <fmt/format.h>
#include <sys/ioctl.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <climits>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <mutex>
#include <regex>
#include <string_view>
#include <system_error>

#include "app/app_context.h"
#include "core/error.h"
#include "core/text.h"
#include "train/run_folder.h"

namespace semfield::app {

namespace {

std::mutex g_stderr;
bool g_live = false;  // a live line stands there

// Columns of the character at `text[i]` and the bytes of it. Wide ones of East Asia take two; of rarer ones two are
// assumed as well, since a line that is too short does no harm.
int columns_of(std::string_view text, std::size_t i, std::size_t& bytes) {
  bytes = std::max<std::size_t>(1, utf8_length(text, i));
  const auto lead = static_cast<unsigned char>(text[i]);
  return bytes < 3 || (lead == 0xE2 && static_cast<unsigned char>(text[i + 1]) < 0xBA) ? 1 : 2;
}

int width_of(std::string_view text) {
  int width = 0;
  for (std::size_t i = 0, bytes = 0; i < text.size(); i += bytes) width += columns_of(text, i, bytes);
  return width;
}

std::string cut(const std::string& text, int columns) {
  std::size_t end = 0, bytes = 0;
  for (int used = 0; end < text.size(); end += bytes) {
    used += columns_of(text, end, bytes);
    if (used > columns) break;
  }
  return text.substr(0, end);
}

std::string joined(const std::vector<LinePart>& parts) {
  std::string line;
  for (const LinePart& part : parts) line += part.text;
  return line;
}

void clear_held() {
  if (g_live) std::fputs("\r\033[K", stderr);
  g_live = false;
}

}  // namespace

std::string fitted(std::vector<LinePart> parts, int columns) {
  std::string line = joined(parts);
  while (width_of(line) > columns && parts.size() > 1) {
    auto least = parts.begin();
    for (auto part = parts.begin(); part != parts.end(); ++part)
      if (part->rank >= least->rank) least = part;
    parts.erase(least);
    line = joined(parts);
  }
  return width_of(line) > columns ? cut(line, columns) : line;
}

std::string wrapped(const std::string& text, int columns, bool hanging) {
  constexpr std::size_t kIndent = 2;
  std::string out;
  int used = 0;
  std::size_t hang = 0;
  for (std::size_t begin = 0; begin < text.size();) {
    if (hanging && (begin == 0 || text[begin - 1] == '\n')) {
      const std::size_t line_end = std::min(text.find('\n', begin), text.size());
      const std::size_t name = text.find_first_not_of(' ', begin), gap = text.find("  ", name);
      const std::size_t value = text.find_first_not_of(' ', gap);
      hang = gap < line_end && value < line_end ? static_cast<std::size_t>(width_of(text.substr(begin, value - begin)))
                                                : kIndent;
      if (hang > static_cast<std::size_t>(columns) / 2) hang = kIndent;
    }
    // A word, with the blanks before it: up to a blank that no command holds.
    std::size_t word = begin;
    while (word < text.size() && text[word] == ' ') ++word;
    std::size_t end = word;
    for (bool command = false; end < text.size() && text[end] != '\n' && (command || text[end] != ' '); ++end)
      if (text[end] == '`') command = !command && text.find('`', end + 1) != std::string::npos;
    if (const std::size_t most = static_cast<std::size_t>(columns) - hang; end - word > most && text[word] != '`')
      if (const std::size_t comma = text.rfind(',', word + most - 1); comma != text.npos && comma > word)
        end = comma + 1;
    const int blanks = static_cast<int>(word - begin),
              width = width_of(std::string_view(text).substr(word, end - word));
    if (used > 0 && used + blanks + width > columns) {
      out += '\n' + std::string(hang, ' ');
      used = static_cast<int>(hang);
    } else {
      out.append(text, begin, word - begin);
      used += blanks;
    }
    out.append(text, word, end - word);
    used += width;
    if (end < text.size() && text[end] == '\n') {
      out += '\n';
      used = 0;
      ++end;
    }
    begin = end;
  }
  return out;
}

std::string painted(std::string text) {
  static const std::pair<std::regex, const char*> kRules[] = {
      {std::regex("(^|\n)(error|semfield: )"), "$1\033[1;31m$2\033[0m"},
      {std::regex("(^|\n)(warning)"), "$1\033[1;33m$2\033[0m"},
      {std::regex("(^|\n)(next|\\$ [^\n]*)"), "$1\033[1m$2\033[0m"},
      {std::regex("`[^`\n]*`"), "\033[1m$&\033[0m"},
      {std::regex("# [^\n]*|\\[[a-z0-9_]+(\\.[a-z0-9_]+)+\\]"), "\033[2m$&\033[0m"}};
  for (const auto& [what, shown] : kRules) text = std::regex_replace(text, what, shown);
  return text;
}

bool has_colors(int stream) {
  const char *const refused = std::getenv("NO_COLOR"), *const kind = std::getenv("TERM");
  return isatty(stream) != 0 && (refused == nullptr || *refused == '\0') && kind != nullptr &&
         std::string_view(kind) != "dumb";
}

int terminal_columns() {
  winsize size{};
  if (ioctl(STDERR_FILENO, TIOCGWINSZ, &size) == 0 && size.ws_col > 0) return size.ws_col;
  const char* const told = std::getenv("COLUMNS");
  const int columns = told == nullptr ? 0 : std::atoi(told);
  return columns > 0 ? columns : 80;
}

void show_live(const std::string& line) {
  const std::lock_guard lock(g_stderr);
  std::fprintf(stderr, "\r\033[K%s", line.c_str());
  std::fflush(stderr);
  g_live = true;
}

void clear_live() {
  const std::lock_guard lock(g_stderr);
  clear_held();
  std::fflush(stderr);
}

void say(const std::string& text, bool terminal) {
  const std::lock_guard lock(g_stderr);
  clear_held();
  const std::string shown = terminal ? wrapped(text, terminal_columns()) : text;
  std::fprintf(stderr, "%s\n", (terminal && has_colors(STDERR_FILENO) ? painted(shown) : shown).c_str());
  std::fflush(stderr);
}

namespace {

constexpr const char* kLeftOut = "SEMFIELD_NEXT_LEFT_OUT";
constexpr double kOverwriteEvery_s = 0.1, kLineEvery_s = 2;

double steady_seconds() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

ProgressLine::Outside stderr_of(bool terminal) {
  if (!terminal) return {steady_seconds, [](const std::string& line) { say(line, false); }};
  return {steady_seconds, [](const std::string& line) { line.empty() ? clear_live() : show_live(line); }};
}

}  // namespace

std::string clock_text(double seconds) {
  const auto s = static_cast<long>(std::lround(std::max(seconds, 0.0)));
  return s >= 3600 ? fmt::format("{}:{:02}:{:02}", s / 3600, s / 60 % 60, s % 60)
                   : fmt::format("{}:{:02}", s / 60, s % 60);
}

std::string figure_text(const std::optional<double>& value, const char* none) {
  return value ? fmt::format("{:.4f}", *value) : none;
}

ProgressLine::ProgressLine(const AppContext& context, std::string done_what, std::string unit)
    : ProgressLine(context, std::move(done_what), std::move(unit), stderr_of(context.terminal)) {}

ProgressLine::ProgressLine(const AppContext& context, std::string done_what, std::string unit, Outside outside)
    : quiet_(context.quiet),
      terminal_(context.terminal),
      done_what_(std::move(done_what)),
      unit_(std::move(unit)),
      outside_(std::move(outside)),
      begin_s_(outside_.now_s()),
      next_s_(begin_s_ + (terminal_ ? 0 : kLineEvery_s)) {}

void ProgressLine::show(double done, double total) {
  const double now_s = outside_.now_s();
  if (quiet_ || (now_s < next_s_ && !(terminal_ && done >= total))) return;
  next_s_ = now_s + (terminal_ ? kOverwriteEvery_s : kLineEvery_s);
  std::vector<LinePart> parts{{0, fmt::format("{} {:.0f}/{:.0f}", done_what_, std::floor(done), total)},
                              {2, " " + unit_}};
  if (done > 0 && done < total)
    parts.push_back({1, fmt::format(", {} left", clock_text((now_s - begin_s_) / done * (total - done)))});
  // The last column stays free: some terminals go to the next line with it.
  outside_.write(fitted(std::move(parts), terminal_ ? outside_.columns() - 1 : INT_MAX));
  open_ = terminal_;
}

void ProgressLine::restart(std::string done_what, std::string unit) {
  end();
  done_what_ = std::move(done_what);
  unit_ = std::move(unit);
  begin_s_ = outside_.now_s();
  next_s_ = begin_s_ + (terminal_ ? 0 : kLineEvery_s);
}

void ProgressLine::end() {
  if (open_) outside_.write("");
  open_ = false;
}

void show_load_progress(AppContext& context) {
  std::shared_ptr<ProgressLine> line;
  std::string shown;
  context.load_progress = [&context, line, shown](std::string_view doing, std::size_t done, std::size_t total) mutable {
    if (doing == "read") return line.reset();
    const std::string what = "scene: " + std::string(doing);
    if (!line) {
      line = std::make_shared<ProgressLine>(context, what);
    } else if (what != shown || done == 1) {  // another scene may be checked long after the first
      line->restart(what);
    }
    shown = what;
    line->show(static_cast<double>(done), static_cast<double>(total));
  };
  context.work.load_progress = &context.load_progress;
}

void print_next(const AppContext& context, const std::vector<NextStep>& steps, const std::string& program) {
  if (context.quiet || context.json || steps.empty() || std::getenv(kLeftOut) != nullptr) return;
  std::string modules;  // a run that was trained with them is read with them
  for (const std::string& module : context.registry.module_files()) modules += " --plugin " + shell_word(module);
  std::size_t longest = 0, explained = 0;
  for (const NextStep& step : steps) {
    longest = std::max(longest, step.words.size());
    explained = std::max(explained, step.what.size());
  }
  constexpr const char *kName = "next        ", *kGap = "   # ";
  const std::size_t longest_line = std::string_view(kName).size() + program.size() + 1 + longest + modules.size() +
                                   std::string_view(kGap).size() + explained;
  const bool narrow = context.terminal && longest_line > static_cast<std::size_t>(terminal_columns());
  std::string text = narrow ? "next" : kName;
  for (const NextStep& step : steps) {
    if (narrow) {
      text += "\n  # " + step.what + "\n  " + program + " " + step.words + modules;
    } else {
      text += (&step == &steps.front() ? "" : "\n" + std::string(std::string_view(kName).size(), ' ')) + program + " " +
              step.words + modules + std::string(longest - step.words.size(), ' ') + kGap + step.what;
    }
  }
  std::fflush(stdout);  // results come first
  say(has_colors(STDERR_FILENO) ? painted(text) : text, false);
}

void leave_next_out_of_children(bool left_out) { left_out ? setenv(kLeftOut, "1", 1) : unsetenv(kLeftOut); }

void print_note(const AppContext& context, const std::string& text) {
  if (!context.quiet) say(text, context.terminal);
}

void create_output_folder(const std::filesystem::path& folder) {
  std::error_code failed;
  if (!folder.empty()) std::filesystem::create_directories(folder, failed);
  if (failed)
    throw Error(ErrorKind::cannot_create, "files.output.create",
                folder.string() + ": cannot create the folder: " + failed.message(),
                "choose a folder that you may write to with --out");
}

std::string json_object(const AppContext& context, const Json& results) {
  Json out{{"semfield", this_environment().version}, {"verb", context.verb}};
  out.update(results);
  return json_text(out) + "\n";
}

void print_json(const AppContext& context, const Json& results) {
  const std::string text = json_object(context, results);
  std::fwrite(text.data(), 1, text.size(), stdout);
  std::fflush(stdout);
}

void print_results(const AppContext& context, const Json& results, const std::string& text) {
  if (context.json) return print_json(context, results);
  std::string shown = isatty(STDOUT_FILENO) != 0 ? wrapped(text, terminal_columns(), true) : text;
  if (has_colors(STDOUT_FILENO)) shown = painted(shown);
  std::fputs(shown.c_str(), stdout);
  if (!text.empty() && !text.ends_with('\n')) std::fputc('\n', stdout);
  std::fflush(stdout);
}

}  // namespace semfield::app
