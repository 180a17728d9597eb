// A run's file of clicks: which it is and whose, whether it is the one that training knew, how it is written and read.
#include "labels/clicks/click_file.h"

#include <sys/resource.h>

#include <csignal>

#include "labels/clicks/click_log.h"
#include "system/files.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using testing_room::fresh_folder;

LabelEvent add(const std::string& id, const std::string& name) {
  return LabelEvent{.id = id, .kind = LabelEventKind::add_class, .class_name = name};
}

std::string log_of(const std::vector<LabelEvent>& events) {
  std::string text;
  for (const LabelEvent& event : events) text += label_event_json(event) + "\n";
  return text;
}

EventsKnown known_of(const std::vector<LabelEvent>& events) {
  EventsKnown known;
  for (const LabelEvent& event : events) known.add(event);
  return known;
}

struct RunOfClicks {
  std::string dir;
  LabelConfig labels;
  explicit RunOfClicks(const std::string& name, int room = 4) : dir(fresh_folder(name)) {
    labels.selection.clicks = dir + "/clicks.jsonl";
    labels.selection.class_room = room;
    settle_click_file(labels, dir);
    write_file_atomic(dir + "/run.yaml", "name: " + name + "\n");
  }
  std::string refusal(const ClicksTrained& trained) const {
    Diagnostics ignored;
    return error_of([&] { require_clicks(trained, labels, dir, ignored); });
  }
  std::string warning(const ClicksTrained& trained) const {
    Diagnostics found;
    require_clicks(trained, labels, dir, found);
    return found.all().empty() ? "" : found.all().front().text();
  }
};

const std::vector<LabelEvent> kThree{add("1", "chair"), add("2", "table"), add("3", "lamp")};

TEST(ClickFile, ARunsOwnIsWrittenAsSuchAndAnotherByItsPlace) {
  RunOfClicks run("click_file_own");
  EXPECT_EQ(run.labels.selection.clicks, "clicks.jsonl");
  EXPECT_EQ(run.labels.click_file(), run.dir + "/clicks.jsonl");
  // Trained anew in another folder: that run's clicks are still those of the first.
  LabelConfig anew{.selection = {.clicks = "clicks.jsonl"}, .run_dir = run.dir};
  settle_click_file(anew, run.dir + "/anew");
  EXPECT_EQ(anew.selection.clicks, run.dir + "/clicks.jsonl");
  LabelConfig none;
  settle_click_file(none, run.dir);
  EXPECT_EQ(none.selection.clicks, "");
  EXPECT_EQ(none.click_file(), "");
}

TEST(ClickFile, ClicksThatTrainingKnewHaveToBeThere) {
  const RunOfClicks run("click_file_lost");
  const std::string file = run.dir + "/clicks.jsonl",
                    remedy = "; put the file back, or say where it is: --set scene.labels.clicks=FILE";
  const ClicksTrained trained{true, known_of(kThree)}, nothing{true, EventsKnown{}}, earlier{true, std::nullopt}, begun;
  EXPECT_EQ(run.refusal(trained),
            "the run '" + run.dir + "' has learned from 3 events of clicks, and '" + file + "' is not there" + remedy);
  EXPECT_EQ(run.refusal(nothing), "");
  EXPECT_EQ(run.refusal(begun), "");
  EXPECT_EQ(run.refusal(earlier), "'" + file + "' is not there, where scene.labels.clicks of the run '" + run.dir +
                                      "' points" + remedy + "; where nobody ever clicked, make an empty one");
  write_file_atomic(file, "");
  EXPECT_EQ(run.refusal(trained),
            "the run '" + run.dir + "' has learned from 3 events of clicks, and '" + file + "' is empty" + remedy);
  EXPECT_EQ(run.refusal(earlier), "");
  write_file_atomic(file, log_of(kThree));
  EXPECT_EQ(run.warning(trained), "");
  std::vector<LabelEvent> more = kThree;
  more.push_back(add("4", "door"));
  write_file_atomic(file, log_of(more));
  EXPECT_EQ(run.warning(trained), "") << "clicks that come later are no change";
  write_file_atomic(file, log_of({kThree[0], kThree[2], kThree[1]}));
  EXPECT_EQ(run.warning(trained),
            "scene.labels.clicks: '" + file +
                "' does not begin with the 3 events that the run has learned from: "
                "other clicks; put the run's own file back, or say where it is: --set scene.labels.clicks=FILE");
  RunOfClicks without("click_file_no_room", 0);
  EXPECT_EQ(without.refusal(begun), "'" + without.dir +
                                        "/clicks.jsonl' is not there, where scene.labels.clicks of the run '" +
                                        without.dir + "' points" + remedy);
}

TEST(ClickFile, NobodyAppendsToAnotherRunsClicks) {
  const RunOfClicks first("click_file_first");
  write_file_atomic(first.dir + "/clicks.jsonl", log_of(kThree));
  LabelConfig labels{.selection = {.clicks = first.dir + "/clicks.jsonl"}};
  Diagnostics diagnostics;
  EXPECT_EQ(error_of([&] { (void)open_click_log(labels, fresh_folder("click_file_second"), diagnostics); })
                .find("the clicks in '" + first.dir +
                      "/clicks.jsonl' are those of another run, so none are added to them; continue that run"),
            0u);
  EXPECT_EQ(read_text_file(first.dir + "/clicks.jsonl"), log_of(kThree));
  ClickLog own = open_click_log(first.labels, first.dir, diagnostics);
  EXPECT_EQ(own.events().size(), 3u);
}

TEST(ClickFile, AFileThatHasGrownSinceItWasReadIsRefused) {
  RunOfClicks run("click_file_grown");
  SceneInfo scene;
  run.labels.clicks.emplace(replay(scene, 4, kThree, "log"));
  write_file_atomic(run.dir + "/clicks.jsonl", log_of({kThree[0]}));
  Diagnostics diagnostics;
  EXPECT_EQ(error_of([&] { (void)open_click_log(run.labels, run.dir, diagnostics); }),
            "'" + run.dir + "/clicks.jsonl' has changed while the scene was opened; start the program again");
  write_file_atomic(run.dir + "/clicks.jsonl", log_of(kThree));
  EXPECT_EQ(open_click_log(run.labels, run.dir, diagnostics).events().size(), 3u);
}

// The file of label events: what is appended stays, torn lines are cut, other bad lines are named.

LabelEvent undo(const std::string& id, const std::string& of) {
  return LabelEvent{.id = id, .kind = LabelEventKind::undo, .of = of};
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
    EXPECT_HAS(findings(read), path + said);
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
      {line("1") + "{\"id\":\"2\"}\n" + line("3"), ":2: event: key 'type' is missing; fix or delete the line"},
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
    EXPECT_HAS(error, path, said);
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

// A program that takes no lock: its lines stay, and nothing is appended behind them or cut off with them.
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
