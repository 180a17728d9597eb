// The file of label events: what is appended stays, torn lines are cut, other bad lines are named.
#include "labels/clicks/click_log.h"

#include <gtest/gtest.h>
#include <sys/resource.h>
#include <unistd.h>

#include <csignal>
#include <filesystem>

#include "system/files.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using testing_room::error_of;
using testing_room::fresh_folder;

LabelEvent undo(const std::string& id, const std::string& of) {
  LabelEvent event;
  event.id = id;
  event.kind = LabelEventKind::undo;
  event.of = of;
  return event;
}

std::string line(const std::string& id) { return label_event_json(undo(id, "x")) + "\n"; }

std::string findings(const Diagnostics& diagnostics) {
  std::string out;
  for (const Diagnostic& d : diagnostics.all()) out += d.text() + "\n";
  return out;
}

std::string ids(const std::vector<LabelEvent>& events) {
  std::string out;
  for (const LabelEvent& event : events) out += event.id + " ";
  return out;
}

TEST(ClickLog, KeepsWhatIsAppended) {
  const std::string path = fresh_folder("click_log_test") + "/clicks.jsonl";
  Diagnostics diagnostics;
  {
    ClickLog log = ClickLog::open(path, diagnostics);
    EXPECT_TRUE(std::filesystem::exists(path));
    EXPECT_TRUE(log.events().empty());
    log.append(undo("1", "x"));
    EXPECT_EQ(read_text_file(path), line("1"));
    ClickLog moved = std::move(log);
    moved.append(undo("2", "x"));
    EXPECT_EQ(ids(moved.events()), "1 2 ");
  }
  ClickLog again = ClickLog::open(path, diagnostics);
  again.append(undo("3", "2"));
  EXPECT_EQ(ids(again.events()), "1 2 3 ");
  EXPECT_EQ(read_click_log(path, diagnostics), again.events());
  EXPECT_EQ(findings(diagnostics), "");
}

TEST(ClickLog, CutsATornLineAndSaysSo) {
  const std::string path = fresh_folder("click_log_test") + "/clicks.jsonl";
  const std::string whole = line("1") + line("2"), said = ":3: the last line is torn";
  for (const std::string& torn : {line("3").substr(0, 1), line("3").substr(0, line("3").size() - 1),
                                  std::string(5, '\0'), line("3").substr(0, 9) + std::string(7, '\0') + "\"}\n"}) {
    testing_room::plain_write(path, whole + torn);
    Diagnostics read, opened;
    EXPECT_EQ(ids(read_click_log(path, read)), "1 2 ");
    EXPECT_NE(findings(read).find(path + said), std::string::npos) << findings(read);
    EXPECT_EQ(read_text_file(path), whole + torn);  // reading changes nothing
    ClickLog log = ClickLog::open(path, opened);
    EXPECT_EQ(findings(opened), findings(read));
    EXPECT_EQ(read_text_file(path), whole);
    log.append(undo("4", "x"));
    EXPECT_EQ(read_text_file(path), whole + line("4"));
  }
}

TEST(ClickLog, RefusesOtherBadLinesAndChangesNothing) {
  const std::string path = fresh_folder("click_log_test") + "/clicks.jsonl";
  const std::pair<std::string, std::string> cases[] = {
      {line("1") + "{\"id\":\"2\"}\n" + line("3"), ":2: event: key 'type' is missing; mend or delete the line"},
      {line("1") + "\n" + line("3"), ":2: event: not valid JSON"},
      {line("1") + "nonsense\n", ":2: event: not valid JSON"},
      {line("1") + line("2") + line("1"),
       ":3: line 1 has the id '1', too; delete one of the lines, or give it another id"},
      {line("1") + "frame,x,y", "' holds no label events: its last line has no end and begins with no '{'"},
  };
  for (const auto& [text, said] : cases) {
    testing_room::plain_write(path, text);
    Diagnostics diagnostics;
    const std::string error = error_of([&] { (void)read_click_log(path, diagnostics); });
    EXPECT_NE(error.find(path), std::string::npos) << error;
    EXPECT_NE(error.find(said), std::string::npos) << error;
    EXPECT_EQ(error_of([&] { (void)ClickLog::open(path, diagnostics); }), error);
    EXPECT_EQ(read_text_file(path), text);
  }
}

TEST(ClickLog, AFailedAppendLeavesTheFileAndALaterOneSucceeds) {
  const std::string path = fresh_folder("click_log_test") + "/clicks.jsonl";
  Diagnostics diagnostics;
  ClickLog log = ClickLog::open(path, diagnostics);
  log.append(undo("1", "x"));
  rlimit before{};
  ASSERT_EQ(getrlimit(RLIMIT_FSIZE, &before), 0);
  const auto handler = std::signal(SIGXFSZ, SIG_IGN);
  const rlimit tight{line("1").size() + 10, before.rlim_max};  // ten bytes of the next line fit
  ASSERT_EQ(setrlimit(RLIMIT_FSIZE, &tight), 0);
  const std::string error = error_of([&] { log.append(undo("2", "x")); });
  ASSERT_EQ(setrlimit(RLIMIT_FSIZE, &before), 0);
  (void)std::signal(SIGXFSZ, handler);
  EXPECT_EQ(error.find("cannot append to '" + path + "': the limit of a file's size is reached: need "), 0u) << error;
  EXPECT_EQ(ids(log.events()), "1 ");
  EXPECT_EQ(read_text_file(path), line("1"));
  log.append(undo("3", "x"));
  EXPECT_EQ(read_text_file(path), line("1") + line("3"));
  EXPECT_EQ(ids(log.events()), "1 3 ");
}

TEST(ClickLog, ASecondWriterIsRefusedAndTold) {
  const std::string folder = fresh_folder("click_log_test"), path = folder + "/clicks.jsonl";
  Diagnostics diagnostics;
  ClickLog log = ClickLog::open(path, diagnostics);
  log.append(undo("1", "x"));
  std::filesystem::create_symlink(path, folder + "/link.jsonl");
  for (const std::string& name : {path, folder + "/link.jsonl", folder + "/./clicks.jsonl"}) {
    const std::string error = error_of([&] { (void)ClickLog::open(name, diagnostics); });
    EXPECT_EQ(error.find("the file of clicks '" + name + "' is in use by process " + std::to_string(getpid()) + " on "),
              0u)
        << error;
  }
  EXPECT_EQ(ids(read_click_log(path, diagnostics)), "1 ");  // reading takes no hold
  { const ClickLog ended = std::move(log); }
  ClickLog again = ClickLog::open(path, diagnostics);
  EXPECT_EQ(ids(again.events()), "1 ");
}

// A program that asks for no lock: its lines stay, and nothing is appended behind them or cut off with them.
TEST(ClickLog, WhatAnotherProgramWroteIsNeitherCutOffNorBuiltUpon) {
  const std::string path = fresh_folder("click_log_test") + "/clicks.jsonl";
  Diagnostics diagnostics;
  ClickLog log = ClickLog::open(path, diagnostics);
  log.append(undo("1", "x"));
  for (const std::string& theirs : {line("1") + line("2"), line("1").substr(4), std::string()}) {
    testing_room::plain_write(path, theirs);
    const std::string error = error_of([&] { log.append(undo("3", "x")); });
    EXPECT_EQ(error, "'" + path + "' has " + std::to_string(theirs.size()) + " bytes where this program left " +
                         std::to_string(line("1").size()) +
                         ": another program has changed it; end that program, and start this one again");
    EXPECT_EQ(read_text_file(path), theirs);
    EXPECT_EQ(ids(log.events()), "1 ");
  }
  std::filesystem::remove(path);
  EXPECT_EQ(error_of([&] { log.append(undo("3", "x")); }),
            "'" + path +
                "' was removed while this program appends to it; put the file back, and start this program "
                "again");
  EXPECT_FALSE(std::filesystem::exists(path));
}

TEST(ClickLog, TellsWhereItCannotBe) {
  Diagnostics diagnostics;
  const std::string folder = fresh_folder("click_log_test");
  EXPECT_EQ(error_of([&] { (void)ClickLog::open(folder + "/none/clicks.jsonl", diagnostics); }),
            "cannot open '" + folder + "/none/clicks.jsonl': No such file or directory; create the folder first");
  EXPECT_EQ(error_of([&] { (void)ClickLog::open(folder, diagnostics); }),
            "'" + folder + "' is a folder, not a file; check the path");
  EXPECT_EQ(error_of([&] { (void)read_click_log(folder + "/none", diagnostics); }),
            "cannot open '" + folder + "/none': No such file or directory; check the path");
}

}  // namespace
}  // namespace semfield
