// Every address of the page over a real socket, against a source that is no training.
#include <future>
#include <nlohmann/json.hpp>

#include "formats/png_codec.h"
#include "tests/says.h"
#include "tests/serve/served_page.h"

namespace semfield::app {
namespace {

using Json = nlohmann::json;
using namespace testing_http;

std::string part_at(const std::string& body, std::size_t& at) {
  std::uint32_t size = 0;
  for (int i = 3; i >= 0; --i) size = size << 8 | static_cast<unsigned char>(body.at(at + static_cast<std::size_t>(i)));
  const std::string part = body.substr(at + 4, size);
  at += 4 + size;
  return part;
}

PngImage png(const std::string& bytes) { return decode_png(std::as_bytes(std::span(bytes))); }

TEST_F(ServedPage, FilesOfTheListAloneAreServedWithTheirTypes) {
  const Answer index = get("");
  EXPECT_EQ(index.status, 200);
  EXPECT_EQ(index.body, "<html></html>");
  EXPECT_EQ(index.header("content-type"), "text/html; charset=utf-8");
  EXPECT_EQ(index.header("referrer-policy"), "no-referrer");
  EXPECT_EQ(index.header("cache-control"), "no-store");
  EXPECT_EQ(index.header("set-cookie"), "");
  EXPECT_EQ(index.header("access-control-allow-origin"), "");
  EXPECT_EQ(index.header("content-security-policy").find("default-src 'self'; img-src 'self' blob: data:;"), 0u);
  EXPECT_EQ(get("app.js").header("content-type"), "text/javascript; charset=utf-8");
  for (const char* other : {"style.css", "../app.js", "..%2fapp.js", "%61pp.js", "./app.js", "app.js/", "/etc/passwd",
                            "../../../../../../etc/passwd", "export/../../x/0", "index.html%00.js"})
    EXPECT_EQ(get(other).status, 404) << other;
}

TEST_F(ServedPage, TheSecretFolderWithoutItsSlashLeadsIntoIt) {
  const Answer onward = ask("GET /" + token() + " HTTP/1.1\r\nHost: " + host() + "\r\n\r\n");
  EXPECT_EQ(onward.status, 308);
  EXPECT_EQ(onward.header("location"), "/" + token() + "/");
}

TEST_F(ServedPage, StateHasTheKeysOfTheContract) {
  const Answer answer = get("state?after=0");
  ASSERT_EQ(answer.status, 200);
  EXPECT_EQ(answer.header("content-type"), "application/json");
  EXPECT_EQ(answer.header("cache-control"), "no-store");
  const Json s = Json::parse(answer.body);
  EXPECT_EQ(s["revision"], 5);
  EXPECT_EQ(s["run"]["id"], "run-1");
  EXPECT_EQ(s["run"]["name"], "room");
  EXPECT_EQ(s["room"], (Json{{"named", 2}, {"most", 8}}));
  EXPECT_EQ(s["classes"][1]["name"], "chair");
  EXPECT_EQ(s["classes"][1]["color"], (Json{200, 30, 30}));
  EXPECT_EQ(s["views"][1], (Json{{"frame", "b"},
                                 {"width", 6},
                                 {"height", 4},
                                 {"clicks", 1},
                                 {"entropy", 0.5},
                                 {"ready", true},
                                 {"photo", "b1"},
                                 {"held_out", false}}));
  EXPECT_EQ(s["proposal"]["at"], (Json{2.5, 3.5}));
  EXPECT_EQ(s["marks"][0]["view"], 1);  // of frame 7
  EXPECT_EQ(s["marks"][0]["points"], (Json{{1.5, 2.5}}));
  EXPECT_EQ(s["history"][0], (Json{1.0, 0.5, 20.0, 1}));
  EXPECT_EQ(s["trouble"], "");
  EXPECT_EQ(s["failure"], "");
}

TEST_F(ServedPage, MarksAndHistoryAreSentWhenTheyAreNewAlone) {
  const Json s = Json::parse(get("state?after=3").body);
  EXPECT_TRUE(s["marks"].is_array());  // changed in revision 4
  EXPECT_TRUE(Json::parse(get("state?after=4").body)["marks"].is_null());
  EXPECT_TRUE(s["history"].is_null());  // in revision 2
}

TEST_F(ServedPage, NewsAreWaitedFor) {
  std::future<Answer> waiting = std::async(std::launch::async, [&] { return get("state?after=5"); });
  EXPECT_EQ(waiting.wait_for(std::chrono::milliseconds(300)), std::future_status::timeout);
  source_.change([](LabelState& s) { s.phase = "changed"; });
  const Answer answer = waiting.get();
  EXPECT_EQ(Json::parse(answer.body)["run"]["phase"], "changed");
  EXPECT_EQ(Json::parse(answer.body)["revision"], 6);
  // Without news the old state comes when the wait is over; a number from an earlier server does not wait.
  EXPECT_EQ(Json::parse(get("state?after=6").body)["revision"], 6);
  EXPECT_TRUE(Json::parse(get("state?after=1000").body)["marks"].is_array());
}

TEST_F(ServedPage, NobodyWaitsForNewsOnceTheSessionEnds) {
  PageOptions o = options();
  o.longest_poll_ms = 600'000;
  start(o);
  server_->end_waiting();
  EXPECT_EQ(Json::parse(get("state?after=5").body)["revision"], 5);
}

TEST_F(ServedPage, APageOfAnEarlierServerGetsEverythingAnew) {
  PageOptions o = options();
  o.first_revision = 1000;
  start(o);
  const Json s = Json::parse(get("state?after=900").body);
  EXPECT_EQ(s["revision"], 1005);
  EXPECT_TRUE(s["marks"].is_array());
  EXPECT_TRUE(Json::parse(get("state?after=1004").body)["marks"].is_null());
}

TEST_F(ServedPage, AnEventIsAppliedOnceAndItsTimeIsTheServers) {
  const Answer first = post("event", click("a-1"));
  ASSERT_EQ(first.status, 200);
  EXPECT_EQ(Json::parse(first.body), (Json{{"applied", true}, {"revision", 6}}));
  EXPECT_EQ(Json::parse(post("event", click("a-1")).body)["applied"], false);
  ASSERT_EQ(source_.events().size(), 1u);
  EXPECT_GT(source_.events()[0].unix_ms, 1'700'000'000'000);
  EXPECT_EQ(source_.events()[0].class_name, "chair");
}

TEST_F(ServedPage, RefusedEventsSayWhyAndWhatToDo) {
  const Answer unknown = post("event", click("a-1", "nobody"));
  EXPECT_EQ(unknown.status, 400);
  EXPECT_EQ(Json::parse(unknown.body),
            (Json{{"error", "no class 'nobody'"}, {"code", "labels.class.unknown"}, {"remedy", "add it first"}}));
  EXPECT_EQ(post("event", click("a-1", "full disk")).status, 503);
  EXPECT_EQ(post("event", click("a-1", "broken")).status, 500);
  EXPECT_EQ(post("event", "{").status, 400);
  EXPECT_EQ(source_.events().size(), 0u);
}

TEST_F(ServedPage, APictureHasItsFactsAndEveryMapThatWasAskedFor) {
  const Answer answer = post("picture", R"({"client":"c","view":1,"color":true,"entropy":true})");
  ASSERT_EQ(answer.status, 200);
  EXPECT_EQ(answer.header("content-type"), "application/octet-stream");
  std::size_t at = 0;
  const Json facts = Json::parse(part_at(answer.body, at));
  EXPECT_EQ(facts["width"], 4);
  EXPECT_EQ(facts["overlay_revision"], 9);
  EXPECT_EQ(facts["stale"], false);
  EXPECT_EQ(part_at(answer.body, at).substr(0, 2), "\xFF\xD8");
  const PngImage labels = png(part_at(answer.body, at));
  EXPECT_TRUE(labels.palette);
  EXPECT_EQ(labels.bytes, (std::vector<std::uint8_t>{0, 1, 2, 2, 0, 1, 2, 2, 0, 1, 2, 6}));
  EXPECT_EQ(labels.palette_alpha, std::vector<std::uint8_t>{0});
  ASSERT_GE(labels.palette_rgb.size(), 21u);  // none, six classes; the last is not named yet
  EXPECT_EQ(std::vector<std::uint8_t>(labels.palette_rgb.begin() + 6, labels.palette_rgb.begin() + 9),
            (std::vector<std::uint8_t>{200, 30, 30}));
  EXPECT_EQ(png(part_at(answer.body, at)).bytes[11], 255);
  EXPECT_EQ(at, answer.body.size());
}

TEST_F(ServedPage, MapsThatWereNotAskedForHaveNoBytes) {
  const Answer answer = post("picture", R"({"client":"c","view":0})");
  std::size_t at = 0;
  part_at(answer.body, at);
  EXPECT_EQ(part_at(answer.body, at), "");
  EXPECT_NE(part_at(answer.body, at), "");
  EXPECT_EQ(part_at(answer.body, at), "");
}

TEST_F(ServedPage, AFreeCameraComesToTheSourceAsItWasSent) {
  ASSERT_EQ(
      post("picture", R"({"client":"c","camera":{"position":[1,2,3],"rotation":[0,-1,0,1,0,0,0,0,1],"fov_deg":75},)"
                      R"("most_px":480,"color":true,"labels":false,"full":true})")
          .status,
      200);
  const PictureRequest& r = source_.requests.at(0);
  EXPECT_EQ(r.view, -1);
  EXPECT_EQ(r.camera->world_from_camera.t.z, 3);
  EXPECT_EQ(r.camera->world_from_camera.r[0][1], -1);
  EXPECT_EQ(r.camera->fov_deg, 75);
  EXPECT_EQ(r.most_px, 480);
  EXPECT_TRUE(r.color && r.full);
  EXPECT_FALSE(r.labels);
}

TEST_F(ServedPage, ALaterPictureOfTheSameClientMakesTheOneThatWaitsStale) {
  source_.hold(true);
  const auto ask_as = [&](const char* client) {
    return std::async(std::launch::async, [this, client] {
      return post("picture", std::string(R"({"client":")") + client + R"(","view":0})");
    });
  };
  std::future<Answer> first = ask_as("one");
  source_.wait_for_requests(1);
  std::future<Answer> other = ask_as("two");
  source_.wait_for_requests(2);
  std::future<Answer> second = ask_as("one");
  std::size_t at = 0;
  const Answer stale = first.get();  // at once, while the others wait
  EXPECT_EQ(Json::parse(part_at(stale.body, at))["stale"], true);
  source_.hold(false);
  for (std::future<Answer>* fresh : {&other, &second}) {
    at = 0;
    EXPECT_EQ(Json::parse(part_at(fresh->get().body, at))["stale"], false);
  }
}

TEST_F(ServedPage, PhotographsMayBeKeptAndShrink) {
  const Answer whole = get("photo?view=1");
  ASSERT_EQ(whole.status, 200);
  EXPECT_EQ(whole.header("content-type"), "image/jpeg");
  // For ever under the name of what it shows alone: the run may be opened again with another image in its place.
  EXPECT_HAS(get("photo?view=1&photo=b1").header("cache-control"), "immutable");
  for (const char* unnamed : {"photo?view=1", "photo?view=1&photo=a1", "photo?view=1&photo="})
    EXPECT_EQ(get(unnamed).header("cache-control"), "no-store") << unnamed;
  EXPECT_EQ(get("photo?view=1&most_px=3").status, 200);
  EXPECT_NE(get("photo?view=1&most_px=3").body, whole.body);
  EXPECT_EQ(get("photo?view=1&most_px=9999").body, whole.body);
  EXPECT_EQ(source_.photos, (std::vector<std::int32_t>{0, 0, 0, 0, 0, 3, 3, 9999}));
  for (const char* wrong : {"photo", "photo?view=2", "photo?view=-1", "photo?view=x", "photo?view=1&most_px=65537",
                            "photo?view=99999999999999999999"})
    EXPECT_EQ(get(wrong).status, 400) << wrong;
}

TEST_F(ServedPage, ACameraIsToldAsPicturesAskForIt) {
  const Json camera = Json::parse(get("camera?view=1").body);
  EXPECT_EQ(camera["position"], (Json{1.0, 2.0, 4.0}));
  EXPECT_EQ(camera["rotation"], (Json{1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0}));
  const Json request{{"client", "c"}, {"camera", camera}, {"color", true}};
  EXPECT_EQ(post("picture", request.dump()).status, 200);
}

TEST_F(ServedPage, APointOfAFreeCameraIsAnsweredByAPhotographThatShowsIt) {
  const auto ask_at = [&](const char* at) {
    const Answer answer = post("picture", std::string(R"({"client":"c","at":)") + at +
                                              R"(,"camera":{"position":[0,0,0],"rotation":[1,0,0,0,1,0,0,0,1]}})");
    EXPECT_EQ(answer.status, 200);
    std::size_t begin = 0;
    return Json::parse(part_at(answer.body, begin));
  };
  const Json found = ask_at("[0.25,0.5]");
  EXPECT_EQ(source_.requests.at(0).at, (PixelPoint{0.25, 0.5}));
  EXPECT_EQ(found["spot"], (Json{{"view", 0}, {"at", {2.5, 1.5}}}));
  EXPECT_EQ(found["nearest_view"], 1);
  const Json hidden = ask_at("[0.75,0]");
  EXPECT_EQ(hidden["spot"], nullptr);
  EXPECT_EQ(hidden["meets_surface"], true);
  EXPECT_EQ(ask_at("[1,1]")["meets_surface"], false);
}

TEST_F(ServedPage, APictureTellsTheClicksOfOtherViews) {
  const Answer answer = post("picture", R"({"client":"c","view":0})");
  std::size_t at = 0;
  const Json head = Json::parse(part_at(answer.body, at));
  EXPECT_EQ(head["marks"], (Json::array({{{"id", "m1"}, {"points", {{0.5, 1.5}, {2.5, 1.5}}}}})));
  EXPECT_FALSE(head.contains("spot"));
}

TEST_F(ServedPage, AViewThatIsNotThereIsNamed) {
  const Answer answer = post("picture", R"({"client":"c","view":2})");
  EXPECT_EQ(answer.status, 400);
  EXPECT_EQ(Json::parse(answer.body)["error"], "view 2: the scene has 2 views");
  EXPECT_TRUE(source_.requests.empty());
}

TEST_F(ServedPage, AnotherMethodIsRefusedWithTheRightOne) {
  EXPECT_EQ(get("event").header("allow"), "POST");
  EXPECT_EQ(post("state", "").header("allow"), "GET");
  EXPECT_EQ(ask(text("OPTIONS", "event", "", "Access-Control-Request-Method: POST\r\n")).status, 405);
  EXPECT_EQ(ask(text("DELETE", "")).status, 405);
}

TEST_F(ServedPage, TwoClientsSeeEachOthersClicks) {
  std::future<Answer> other = std::async(std::launch::async, [&] { return get("state?after=5"); });
  ASSERT_EQ(post("event", click("a-1")).status, 200);
  EXPECT_EQ(Json::parse(other.get().body)["events"], 1);
}

TEST_F(ServedPage, AConnectionServesManyRequests) {
  Connection c(port());
  for (int i = 0; i < 200; ++i) {
    ASSERT_TRUE(c.send(text("POST", "event", click("k-" + std::to_string(i)))));
    ASSERT_EQ(c.receive().status, 200) << i;
  }
  EXPECT_EQ(source_.events().size(), 200u);
}

}  // namespace
}  // namespace semfield::app
