// How the search of the site ranks: guides first, then other pages, and last the reference.
var Scorer = {
  score: ([page, , , , score]) => score + (page.startsWith('howto/') ? 8 : /^(api|_modules)\//.test(page) ? -30 : 0),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
