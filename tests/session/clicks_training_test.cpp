// Trainings whose labels come click by click: logits from the start, labels from the file, checkpoints before and
// after.
#include "core/error.h"
#include "labels/clicks/click_log.h"
#include "session/assembly.h"
#include "session/training.h"
#include "system/files.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

LabelEvent add(const std::string& id, const std::string& name) {
  return LabelEvent{.id = id, .kind = LabelEventKind::add_class, .class_name = name};
}

LabelEvent rename(const std::string& id, const std::string& from, const std::string& to) {
  LabelEvent event = add(id, from);
  event.kind = LabelEventKind::change_class;
  event.new_name = to;
  return event;
}

LabelEvent click(const std::string& id, const std::string& frame, const std::string& name, PixelPoint at) {
  return LabelEvent{
      .id = id, .frame = frame, .width_px = 48, .height_px = 36, .points = {at}, .radius_px = 5, .class_name = name};
}

void write_log(const std::string& path, const std::vector<LabelEvent>& events) {
  std::string text;
  for (const LabelEvent& event : events) text += label_event_json(event) + "\n";
  write_file_atomic(path, text);
}

// The room without labels of its own, or with them and `labels` of the configuration.
std::string yaml_of(const std::string& labels, bool own = false, const std::string& more = "") {
  std::string yaml = two_pass_config(more);
  yaml.replace(yaml.find("analytic_room}"), 14,
               std::string("analytic_room") + (own ? "" : ", with_labels: false, with_classes: false") + ", labels: {" +
                   labels + "}}");
  yaml.replace(yaml.find("rays: 64}"), 9, "rays: 64, ray_source: label_balanced}");
  return yaml;
}

struct Room {
  Registry registry = make_registry();
  TempDir dir;
  std::string log = dir / "clicks.jsonl";

  std::string first_frame() {
    const Session session = open_text(two_pass_config(), registry);
    return session.scene.info.frames[session.drawn_frames().front()].name;
  }
  std::unique_ptr<Training> open(const std::string& yaml) {
    return std::make_unique<Training>(run_config_of(parse_config_text(yaml, "test.yaml"), registry), registry);
  }
  std::string refusal(const std::string& yaml) {
    return error_of([&] { (void)open(yaml); });
  }
};

std::string table_of(const Session& session) {
  std::string out;
  for (const ClassEntry& e : session.scene.info.classes.entries()) out += std::to_string(e.id) + "=" + e.name + " ";
  return out;
}

std::int64_t labelled_pixels(const Session& session) {
  std::int64_t count = 0;
  for (const std::vector<std::int64_t>& pixels : session.labels.class_pixels) {
    for (std::size_t c = 0; c + 1 < pixels.size(); ++c) count += pixels[c];
  }
  return count;
}

std::uint32_t bits_of(const Training& training) { return fingerprint(training.session().pipeline->store()); }

TEST(ClicksTraining, ASceneWithoutAnyLabelHasAllLogitsAndTrains) {
  Room room;
  const auto training = room.open(yaml_of("clicks: " + room.log + ", class_room: 4"));
  EXPECT_EQ(table_of(training->session()), "0=void 1=unnamed 1 2=unnamed 2 3=unnamed 3 4=unnamed 4 ");
  EXPECT_TRUE(training->session().plan.semantics);
  EXPECT_EQ(training->session().plan.class_of_logit, (std::vector<int>{0, 1, 2, 3}));
  EXPECT_EQ(training->session().config.runtime.keep, (std::vector<std::string>{"semantics", "absent_classes"}));
  EXPECT_EQ(labelled_pixels(training->session()), 0);
  EXPECT_EQ(training->train(3), 3);
  const SplitScore score = training->evaluate(training->session().scene.frames_of(Split::test));
  EXPECT_TRUE(score.color.psnr_db().has_value());
}

TEST(ClicksTraining, TheFilePaintsAlsoWithoutAnyLabelledFrame) {
  Room room;
  const std::string frame = room.first_frame();
  write_log(room.log, {add("1", "sofa"), click("2", frame, "sofa", {20, 10})});
  const auto training = room.open(yaml_of("frames: none, clicks: " + room.log, true));
  const Session& session = training->session();
  const int classes = open_text(two_pass_config(), room.registry).classes();
  EXPECT_EQ(session.classes(), classes + 1);
  EXPECT_EQ(session.scene.info.classes.valid(classes).name, "sofa");
  EXPECT_EQ(session.manifest.labelled_frames, 1);
  EXPECT_EQ(labelled_pixels(session), session.manifest.train_class_pixels.back());
  EXPECT_GT(labelled_pixels(session), 60);
  EXPECT_EQ(session.labels.frames[session.drawn_frames().front()][10 * 48 + 20], classes);
  EXPECT_EQ(training->train(2), 2);
}

TEST(ClicksTraining, AFileThatIsNotThereCountsOnlyWithRoom) {
  Room room;
  EXPECT_EQ(room.refusal(yaml_of("clicks: " + room.log, true)),
            "scene.labels.clicks: cannot open '" + room.log + "': No such file or directory; check the path");
  EXPECT_HAS(room.refusal(yaml_of("", false)), "no training pixel carries a label");
  write_log(room.log, {add("1", "sofa"), click("2", "no such frame", "sofa", {20, 10})});
  EXPECT_EQ(room.refusal(yaml_of("clicks: " + room.log, true)),
            "scene.labels.clicks: " + room.log +
                ":2: event '2': no frame 'no such frame'; see `semfield inspect` for "
                "the names");
}

TEST(ClicksTraining, LabelsThatComeSwitchTheBalancedSourceOn) {
  Room room;
  const std::string yaml = yaml_of("clicks: " + room.log + ", class_room: 3");
  const auto training = room.open(yaml);
  Annotations clicks = *training->session().config.labels.clicks;
  training->train(2);
  const int frame = training->session().drawn_frames().front();
  const std::string name = training->session().scene.info.frames[frame].name;
  clicks.apply(add("1", "sofa"));
  clicks.apply(click("2", name, "sofa", {20, 10}));
  training->set_clicks(clicks, std::vector<int>{frame});
  EXPECT_EQ(table_of(training->session()), "0=void 1=sofa 2=unnamed 2 3=unnamed 3 ");
  const auto rank = training->rays().choose(2, 1);
  EXPECT_EQ(rank.frame, 0) << "half of the rays go to the labelled pixels, all of one frame";
  training->advance();
  EXPECT_GT(training->losses().semantic, 0);
  // Undone again: as before the first click.
  LabelEvent undo = add("3", "");
  undo.kind = LabelEventKind::undo;
  undo.of = "2";
  clicks.apply(undo);
  training->set_clicks(clicks, std::vector<int>{frame});
  EXPECT_EQ(labelled_pixels(training->session()), 0);
  EXPECT_TRUE(training->session().labels.frames[frame].empty());
  training->advance();
  EXPECT_EQ(training->losses().semantic, 0);
}

TEST(ClicksTraining, ACheckpointFindsItsLabelsInTheFile) {
  // Click, save, more clicks in the file, load: no labels to set, other names are taken; the bits are those of a
  // training that was never stopped.
  Room room;
  const std::string yaml = yaml_of("clicks: " + room.log + ", class_room: 3");
  const std::string name = room.first_frame();
  std::vector<LabelEvent> events{add("1", "sofa"), click("2", name, "sofa", {20, 10})};
  const std::vector<LabelEvent> later{rename("3", "sofa", "couch"), add("4", "lamp"),
                                      click("5", name, "lamp", {30, 20})};
  const auto to_ten = [&](bool stop) {
    write_log(room.log, {});
    auto training = room.open(yaml);
    Annotations clicks = *training->session().config.labels.clicks;
    const int frame = training->session().drawn_frames().front();
    training->train(2);
    for (const LabelEvent& event : events) clicks.apply(event);
    training->set_clicks(clicks, std::vector<int>{frame});
    training->train(4);
    for (const LabelEvent& event : later) clicks.apply(event);
    if (stop) {
      training->save(room.dir / "at_6.safetensors");
      std::vector<LabelEvent> all = events;
      all.insert(all.end(), later.begin(), later.end());
      write_log(room.log, all);
      training = room.open(yaml);
      EXPECT_EQ(table_of(training->session()), "0=void 1=couch 2=lamp 3=unnamed 3 ");
      training->load(room.dir / "at_6.safetensors");
      EXPECT_EQ(training->step(), 6);
    } else {
      training->set_clicks(clicks, std::vector<int>{frame});
    }
    training->train(4);
    return bits_of(*training);
  };
  EXPECT_EQ(to_ten(true), to_ten(false));
}

TEST(ClicksTraining, ACheckpointWithoutTheFileThatNamedItsClassesIsRefused) {
  Room room;
  const std::string yaml = yaml_of("clicks: " + room.log + ", class_room: 3");
  write_log(room.log, {add("1", "sofa"), click("2", room.first_frame(), "sofa", {20, 10})});
  const auto training = room.open(yaml);
  training->train(1);
  training->save(room.dir / "at_1.safetensors");
  std::filesystem::remove(room.log);
  const auto bare = room.open(yaml);
  EXPECT_EQ(error_of([&] { bare->load(room.dir / "at_1.safetensors"); }),
            "the scene's class table is not the one that the run was trained with: class 1 was 'sofa', and is "
            "'unnamed 1' now; give the file of clicks that named it: --set scene.labels.clicks=FILE");
  EXPECT_EQ(bare->step(), 0);
}

TEST(ClicksTraining, ClicksOfAnotherSessionAreRefused) {
  Room room;
  const auto plain = room.open(yaml_of("", true));
  const auto clicked = room.open(yaml_of("class_room: 9", true));
  const Annotations& clicks = *clicked->session().config.labels.clicks;
  EXPECT_THROW(plain->set_clicks(clicks, std::vector<int>{plain->session().drawn_frames().front()}), Error);
  EXPECT_THROW(clicked->set_clicks(clicks, clicked->session().scene.frames_of(Split::test)), Error);
  EXPECT_NO_THROW(clicked->set_clicks(clicks, clicked->session().drawn_frames()));
}

TEST(ClicksTraining, WithoutTheKeysTheBitsAreThose) {
  // With a log of no events over labels of the scene, too.
  Room room;
  write_log(room.log, {});
  EXPECT_EQ(train_fingerprint(yaml_of("", true), 2, 4), train_fingerprint(yaml_of("clicks: " + room.log, true), 2, 4));
}

// --- class tables of checkpoints ---

std::string compared(const std::vector<LabelEvent>& then, const std::vector<LabelEvent>& now, int room_now = 3) {
  SceneInfo scene{.classes = ClassTable({{0, "void", {}, true}, {1, "wall", {}, false}})};
  const ClassTable before = replay(scene, 3, then, "then").classes();
  const std::optional<Annotations> clicks = replay(scene, room_now, now, "now");
  return error_of([&] { require_class_table(before.to_yaml(), clicks->classes(), clicks); });
}

TEST(TrainedClasses, NamesThatClicksGiveMayChange) {
  EXPECT_EQ(compared({}, {}), "");
  EXPECT_EQ(compared({}, {add("1", "sofa")}), "") << "named since";
  EXPECT_EQ(compared({add("1", "sofa")}, {add("1", "sofa"), rename("2", "sofa", "couch")}), "") << "renamed since";
  LabelEvent undo = add("2", "");
  undo.kind = LabelEventKind::undo;
  undo.of = "1";
  EXPECT_EQ(compared({add("1", "sofa")}, {add("1", "sofa"), undo}), "") << "undone since; it keeps its place";
  EXPECT_HAS(compared({add("1", "sofa")}, {}), "class 2 was 'sofa', and is 'unnamed 2' now");
  EXPECT_HAS(compared({}, {}, 4), "class 4 was not in the table, and is 'unnamed 4' now");
  EXPECT_HAS(compared({}, {}, 2), "class 3 was 'unnamed 3', and is not in the table now");
}

TEST(TrainedClasses, TheScenesOwnNamesMayNot) {
  SceneInfo scene{.classes = ClassTable({{0, "void", {}, true}, {1, "door", {}, false}})};
  const std::optional<Annotations> clicks = replay(scene, 3, {add("1", "sofa")}, "now");
  const auto compare = [&](const std::string& yaml) {
    return error_of([&] { require_class_table(yaml, clicks->classes(), clicks); });
  };
  const std::string rest = ", {id: 2, name: x}, {id: 3, name: unnamed 3}]";
  EXPECT_EQ(compare("[{id: 0, name: void, ignore: true}, {id: 1, name: door}" + rest), "");
  EXPECT_HAS(compare("[{id: 0, name: void, ignore: true}, {id: 1, name: wall}" + rest),
             "class 1 was 'wall', and is "
             "'door' now; restore");
  EXPECT_HAS(compare("[{id: 0, name: void, ignore: true}, {id: 1, name: door}, {id: 2, name: x, ignore: true}, {id: 3, "
                     "name: unnamed 3}]"),
             "class 2 was 'x', ignored, and is 'sofa' now");
}

}  // namespace
}  // namespace semfield
