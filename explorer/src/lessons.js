// What the page says: four captions with the paper's equations, and the scenes of the tour.

const i = name => `<mi>${name}</mi>`, o = sign => `<mo>${sign}</mo>`;
const sup = (name, sign) => `<msup>${i(name)}<mo>${sign}</mo></msup>`, sub = (name, index) => `<msub>${i(name)}<mi>${index}</mi></msub>`;
const math = (label, body) => `<math display="block" aria-label="${label}"><mrow>${body}</mrow></math>`;
const reward = (x, u) => `${i('r')}${o('(')}${x}${o(',')}${u}${o(')')}`;
const hat = `<msub><mover accent="true"><mi>x</mi><mo>^</mo></mover><mi>t</mi></msub>`;

export const LESSONS = [
  {
    title: '1. Segment',
    math: math('P of X plus given X minus, U minus, U plus and Z',
      `${i('P')}${o('(')}${sup('X', '+')}${o('|')}${sup('X', '−')}${o(',')}${sup('U', '−')}${o(',')}${sup('U', '+')}${o(',')}${i('Z')}${o(')')}`),
    text: 'A segment model predicts the next ten states X⁺ as a whole, from the ten before, the torques before, and the torques '
      + 'to come U⁺. Chained, ten segments make two seconds. A one-step model predicts one state at a time.',
  },
  {
    title: '2. Code',
    math: math('Z is drawn from a standard normal distribution', `${i('Z')}${o('∼')}${i('N')}${o('(')}<mn>0</mn>${o(',')}${i('I')}${o(')')}`),
    text: 'All that the model does not know about a segment is in its code Z, eight numbers. Z = 0 is drawn as the arm. The fan '
      + 'is 32 futures with random codes: where it is wide, the model doubts. A model without codes cannot doubt.',
  },
  {
    title: '3. Prior',
    math: math('Maximise over the codes z 1 to z K the expected sum of rewards, with torques from the action prior',
      `<munder><mi>max</mi><mrow>${sub('z', '1')}<mo>…</mo>${sub('z', 'K')}</mrow></munder>${i('E')}<mo>[</mo><munder><mo>∑</mo><mi>t</mi></munder>`
      + `${reward(sub('x', 't'), sub('u', 't'))}<mo>]</mo>${o(',')}<mspace width="0.6em"/>${sub('u', 't')}${o('∼')}${i('P')}${o('(')}${sub('u', 't')}${o('|')}${sub('u', '1:t−1')}${o(',')}${i('Z')}${o(')')}`),
    text: 'The planner tries 64 plans, keeps the best, and tries again around them (CEM). Searching codes of an action prior (Eq. 3) '
      + 'it can only find torques like those of the training data; searching torques (Eq. 2) it can find any.',
  },
  {
    title: '4. Exploitation',
    math: math('Gap: the sum of rewards of predicted states minus the sum of rewards of executed states',
      `<munder><mo>∑</mo><mi>t</mi></munder>${reward(hat, sub('u', 't'))}<mo>−</mo><munder><mo>∑</mo><mi>t</mi></munder>${reward(sub('x', 't'), sub('u', 't'))}`),
    text: 'A plan is chosen because its prediction is good, so the search finds the model’s mistakes. The gap between predicted '
      + 'and executed return says how much the model was fooled: a dot below the diagonal promised more than it got.',
  },
];

export const TOUR = [
  {
    title: 'An easy push',
    link: '#task=push&model=rtsm&space=latent&replan=0&seed=1&arm=1.7,-1.4&target=-0.12,-0.11&block=0.06,-0.08',
    text: 'The recurrent TSM predicts (left), the planner picks torques, and MuJoCo executes them without looking again (right). '
      + 'The two agree: predicted and executed return are close, and the object arrives.',
  },
  {
    title: 'A bounce',
    link: '#task=push&model=rtsm&space=latent&replan=0&seed=1&arm=-3.1,2&target=0.17,-0.08&block=0.13,0.05',
    text: 'Here the object meets a wall and bounces off it. What happens then depends on the last millimetre, so the thin lines '
      + 'spread: the model says that it is less sure, and the execution falls among its futures rather than on their middle.',
  },
  {
    title: 'A fooled one-step model',
    link: '#task=push&model=onestep&space=direct&replan=0&seed=1&arm=1.7,-1.4&target=-0.12,-0.11&block=0.06,-0.08',
    text: 'The first scene again, with a model that predicts one state at a time, and a planner free to choose any torques. It found '
      + 'a plan that the model likes and the arm does not follow: the predicted return is far above the executed one.',
  },
  {
    title: 'What the prior forbids',
    link: '#task=push&model=onestep&space=latent&replan=0&seed=1&arm=1.7,-1.4&target=-0.12,-0.11&block=0.06,-0.08',
    text: 'Same start, same one-step model, but the planner searches codes of the action prior. Torques unlike the training data, '
      + 'which fooled the model, are out of its reach: what was promised is what is got.',
  },
  {
    title: 'Planning again',
    link: '#task=push&model=rtsm&space=latent&replan=1&seed=1&arm=1.3,0.4&target=0.15,0.09&block=-0.11,-0.05',
    text: 'A long way round. One plan, executed without looking, misses by 12 cm (untick “Plan again” and see). Looking every ten '
      + 'steps (0.2 s) and planning the rest anew, it ends far nearer; how near depends on the candidates this machine has time for.',
  },
];
