// Requests for pictures and exports: what is accepted, and what the refusals say.
#include "app/serve/page_requests.h"

#include <gtest/gtest.h>

#include "core/error.h"

namespace semfield::app {
namespace {

std::string refusal(const std::string& json) {
  try {
    (void)parse_picture_request(json);
  } catch (const Error& e) {
    EXPECT_EQ(e.kind(), ErrorKind::data);
    return e.what();
  }
  return "accepted";
}

TEST(PictureRequestText, WrongOnesAreNamed) {
  const std::string good_camera = R"({"position":[0,0,0],"rotation":[1,0,0,0,1,0,0,0,1]})";
  const std::vector<std::pair<std::string, std::string>> rows{
      {"[]", "expected a map, got a list of 0"},
      {"{", "not valid JSON"},
      {"{}", "key 'client' is missing"},
      {R"({"client":"c"})", "either 'view' or 'camera'"},
      {R"({"client":"c","view":1,"camera":)" + good_camera + "}", "either 'view' or 'camera'"},
      {R"({"client":"a b","view":1})", "'client': expected"},
      {R"({"client":"c","view":-1})", "'view': expected a whole number from 0"},
      {R"({"client":"c","view":1.5})", "'view': expected"},
      {R"({"client":"c","view":1,"view":2})", "key \"view\" is given twice"},
      {R"({"client":"c","veiw":1})", "did you mean 'view'?"},
      {R"({"client":"c","view":1,"most_px":2049})", "'most_px': expected a whole number from 16 to 2048"},
      {R"({"client":"c","view":1,"color":1})", "'color': expected true or false"},
      {R"({"client":"c","view":1,"labels":false})", "no map is asked for"},
      {R"({"client":"c","view":1,"at":[0,0]})", "'at' is a point of a camera's picture"},
      {R"({"client":"c","at":[0],"camera":)" + good_camera + "}", "'at': expected 2 numbers, got a list of 1"},
      {R"({"client":"c","at":[0,-0.1],"camera":)" + good_camera + "}", "'at': expected shares of width and height"},
      {R"({"client":"c","at":[0,1.1],"camera":)" + good_camera + "}", "'at': expected 2 numbers"},
      {R"({"client":"c","at":[0,1],"labels":true,"camera":)" + good_camera + "}", "'labels' and 'at'"},
      {R"({"client":"c","camera":7})", "'camera': expected a map"},
      {R"({"client":"c","camera":{"position":[0,0,0]}})", "'rotation' is missing"},
      {R"({"client":"c","camera":{"position":[0,0],"rotation":[1,0,0,0,1,0,0,0,1]}})",
       "'position': expected 3 numbers"},
      {R"({"client":"c","camera":{"position":[0,0,1e300],"rotation":[1,0,0,0,1,0,0,0,1]}})", "of a size that a scene"},
      {R"({"client":"c","camera":{"position":[0,0,0],"rotation":[1,0,0,0,1,0,0,0,0.9]}})", "is no rotation"},
      {R"({"client":"c","camera":{"position":[0,0,0],"rotation":[1,0,0,0,1,0,0,0,-1]}})", "is no rotation"},
      {R"({"client":"c","camera":{"position":[0,0,0],"rotation":[1,0,0,0,1,0,0,0,1],"fov_deg":171}})",
       "degrees from 1"},
      {R"({"client":"c","camera":{"position":[0,0,0],"position":[0,0,0],"rotation":[1,0,0,0,1,0,0,0,1]}})",
       "given twice"}};
  for (const auto& [json, words] : rows)
    EXPECT_NE(refusal(json).find(words), std::string::npos) << json << "\n  " << refusal(json);
}

TEST(PictureRequestText, LabelsAreTheDefault) {
  const PictureRequest r = parse_picture_request(R"({"client":"c-1_","view":3})");
  EXPECT_EQ(r.view, 3);
  EXPECT_TRUE(r.labels);
  EXPECT_FALSE(r.color || r.entropy || r.full || r.camera);
}

TEST(ExportRequestText, KindsHaveNames) {
  for (const ExportKind kind : {ExportKind::labels, ExportKind::coco, ExportKind::mesh})
    EXPECT_EQ(parse_export_request(std::string(R"({"what":")") + export_name(kind) + "\"}").what, kind);
  const ExportRequest end = parse_export_request(R"({"cancel":"coco-1"})");
  EXPECT_FALSE(end.what.has_value());
  EXPECT_EQ(end.cancel, "coco-1");
  for (const char* bad : {"{}", R"({"what":"all"})", R"({"what":1})", R"({"what":"coco","to":"/etc"})", "null",
                          R"({"what":"coco","cancel":"coco-1"})", R"({"cancel":1})", R"({"cancel":"../x"})"})
    EXPECT_THROW((void)parse_export_request(bad), Error) << bad;
}

TEST(QueryNumber, IsWholeAndBounded) {
  EXPECT_EQ(query_number("", "a", 7, 9), 7u);
  EXPECT_EQ(query_number("b=3&a=4", "a", 7, 9), 4u);
  EXPECT_EQ(query_number("aa=3", "a", 7, 9), 7u);
  for (const char* bad : {"a", "a=", "a=x", "a=-1", "a=10", "a=4.5", "a=4%20", "a=+4"})
    EXPECT_THROW((void)query_number(bad, "a", 7, 9), Error) << bad;
}

}  // namespace
}  // namespace semfield::app
