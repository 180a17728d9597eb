// Which file holds a run's clicks, whether it is the one that training knew, and whose it is.
#include "labels/clicks/click_file.h"

#include <gtest/gtest.h>

#include <filesystem>

#include "system/files.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using testing_room::error_of;
using testing_room::fresh_folder;

LabelEvent add(const std::string& id, const std::string& name) {
  LabelEvent event;
  event.id = id;
  event.kind = LabelEventKind::add_class;
  event.class_name = name;
  return event;
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
  LabelConfig anew;
  anew.selection.clicks = "clicks.jsonl";
  anew.run_dir = run.dir;
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
  LabelConfig labels;
  labels.selection.clicks = first.dir + "/clicks.jsonl";
  Diagnostics diagnostics;
  EXPECT_EQ(error_of([&] { (void)open_click_log(labels, fresh_folder("click_file_second"), diagnostics); })
                .find("the clicks in '" + first.dir +
                      "/clicks.jsonl' are those of another run, so none are added to them; go on with that run"),
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

}  // namespace
}  // namespace semfield
