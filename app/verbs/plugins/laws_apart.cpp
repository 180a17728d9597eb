#include "app/verbs/plugins/laws_apart.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <csignal>
#include <cstdio>
#include <cstring>
#include <optional>

#include "app/json_output.h"
#include "core/error.h"

namespace semfield::app {

namespace {

// What the two processes say to each other: an object per line. "begun" and "ended" hold a row, "error" an Error;
// "done" says that every law was checked.
Json message_of(const LawRow& row) {
  return {
      {"kind", static_cast<int>(row.kind)},     {"name", row.name},  {"settings", row.settings}, {"build", row.build},
      {"status", static_cast<int>(row.status)}, {"found", row.found}};
}

LawRow row_in(const Json& said) {
  return {static_cast<PluginKind>(said["kind"].get<int>()),  said["name"], said["settings"], said["build"],
          static_cast<LawStatus>(said["status"].get<int>()), said["found"]};
}

Json message_of(const Error& error) {
  return {{"kind", static_cast<int>(error.kind())},
          {"code", error.code().text()},
          {"message", error.message()},
          {"remedy", error.remedy()},
          {"context", error.context()}};
}

Error error_in(const Json& said) {
  const Code code = Code::parse(said["code"].get<std::string>()).value_or(Code("internal.exception"));
  Error error(static_cast<ErrorKind>(said["kind"].get<int>()), code, said["message"], said["remedy"]);
  const std::vector<std::string> context = said["context"];
  for (auto doing = context.rbegin(); doing != context.rend(); ++doing) error.while_doing(*doing);
  return error;
}

void say(int pipe, const char* what, const Json& value) {
  const std::string line = Json{{what, value}}.dump(-1, ' ', false, Json::error_handler_t::replace) + "\n";
  for (std::size_t at = 0; at < line.size();) {
    const ssize_t written = write(pipe, line.data() + at, line.size() - at);
    if (written < 0 && errno != EINTR) _exit(1);  // nobody listens any more
    at += static_cast<std::size_t>(std::max<ssize_t>(written, 0));
  }
}

[[noreturn]] void ask(int pipe, const std::function<void(LawRequest&)>& laws) {
  LawRequest request;
  request.on_begin = [&](const LawRow& row) { say(pipe, "begun", message_of(row)); };
  request.on_row = [&](const LawRow& row) { say(pipe, "ended", message_of(row)); };
  try {
    laws(request);
    say(pipe, "done", true);
  } catch (const Error& error) {
    say(pipe, "error", message_of(error));
  } catch (const std::exception& error) {
    say(pipe, "error", message_of(Error(ErrorKind::internal, "internal.exception", error.what())));
  }
  std::fflush(nullptr);
  _exit(0);
}

std::string how_it_ended(int status) {
  if (WIFEXITED(status)) return fmt::format("it ended the process with exit code {}", WEXITSTATUS(status));
  return fmt::format("it ended the process by signal {} ({})", WTERMSIG(status), strsignal(WTERMSIG(status)));
}

}  // namespace

void ask_laws_apart(const std::string& file, const std::function<void(LawRequest&)>& laws,
                    const std::function<void(const LawRow&)>& on_row) {
  std::fflush(nullptr);
  std::array<int, 2> ends{-1, -1};
  const pid_t parent = getpid();
  const pid_t pid = pipe2(ends.data(), O_CLOEXEC) == 0 ? fork() : -1;
  if (pid < 0)
    throw Error(ErrorKind::unavailable, "system.process.limit", "no process can be started",
                "see what limits them: ulimit -a");
  if (pid == 0) {
    prctl(PR_SET_PDEATHSIG, SIGTERM);  // a parent that is killed leaves no child behind
    if (getppid() != parent) _exit(128 + SIGTERM);
    close(ends[0]);
    ask(ends[1], laws);
  }
  close(ends[1]);
  std::optional<LawRow> under_way;
  std::optional<Error> thrown;
  bool begun = false, done = false;
  const auto hear = [&](const Json& said) {
    if (said.contains("begun")) under_way = row_in(said["begun"]);
    begun = begun || under_way;
    if (said.contains("ended")) {
      under_way.reset();
      on_row(row_in(said["ended"]));
    }
    if (said.contains("error")) thrown = error_in(said["error"]);
    done = done || said.contains("done");
  };
  std::FILE* const lines = fdopen(ends[0], "r");
  std::string line;
  for (int c = std::getc(lines); c != EOF; c = std::getc(lines)) {
    if (c != '\n') {
      line += static_cast<char>(c);
      continue;
    }
    hear(Json::parse(line));
    line.clear();
  }
  std::fclose(lines);
  int status = 0;
  while (waitpid(pid, &status, 0) < 0 && errno == EINTR) {
  }
  if (thrown) throw Error(*thrown);
  if (done) return;
  if (!begun) {
    throw Error(ErrorKind::unavailable, "plugin.module.ended",
                "cannot load plugin '" + file + "': " + how_it_ended(status),
                "fix it: a module registers its plugins, and no more");
  }
  LawRow row = under_way.value_or(LawRow{});
  row.status = LawStatus::failed;
  row.found = {how_it_ended(status) + " before the law was asked to its end"};
  on_row(row);
}

}  // namespace semfield::app
